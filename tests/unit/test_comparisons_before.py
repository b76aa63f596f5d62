"""Where trials of a population were compared before a sweep was resumed, as their results tell it."""

from pathlib import Path
from typing import Any

import pytest
from spec_errors import MINIMAL

from analysis.records import ChangeRecord, IterationRecord, TrialRecord
from tune_jobs.search.comparisons import Comparison, comparisons_before, last_over, made_together
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.names import RESULTS
from tune_jobs.store.sweep_store import SweepStore


def spec_of(interval: int, every: int) -> SweepSpec:
    return load_spec(
        {
            **MINIMAL, "space": {"lr": {"loguniform": [1e-4, 1e-2]}}, "num_samples": 4,
            "scheduler": {"type": "pbt", "perturb_every_env_steps": interval},
            "evaluation": {"every_iterations": every},
        }
    )  # fmt: skip


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    store = SweepStore(tmp_path / "mine")
    store.create()
    return store


def trained(
    store: SweepStore, index: int, iterations: int, every: int, *, not_finite: int = 0, **given: Any
) -> TrialRecord:
    """A trial with iterations of 100 env steps, of which each `every`th was evaluated."""
    record = TrialRecord(
        trial_id=f"t{index:04d}", index=index, point_index=index, seed=index, point={"lr": 1e-3},
        **{"status": "paused", "num_env_steps": 100 * iterations, **given},
    )  # fmt: skip
    store.trial(record.trial_id).append_iterations(
        [
            IterationRecord(
                iteration=number, num_env_steps=100 * number, num_episodes=number, time_s=1.0,
                evaluation_return=float(number) if number % every == 0 and number != not_finite else None,
            )
            for number in range(1, iterations + 1)
        ]
    )  # fmt: skip
    return record


@pytest.mark.parametrize(
    ("interval", "every", "places"),
    [
        (240, 1, [300, 600, 900, 1_200]),
        (200, 3, [300, 600, 900, 1_200]),
        (250, 4, [400, 800, 1_200]),
        (500, 2, [600, 1_200]),
        (200, 2, [200, 400, 600, 800, 1_000, 1_200]),
        (1_301, 1, []),
    ],
)
def test_an_interval_counts_from_the_comparison_before_and_ends_at_an_evaluation(
    store: SweepStore, interval: int, every: int, places: list[int]
) -> None:
    record = trained(store, 0, 13, every)
    found = comparisons_before(store, spec_of(interval, every), [record])
    assert found == {"t0000": tuple(Comparison(place, place / 100) for place in places)}


def test_an_evaluation_that_was_no_finite_number_was_compared_too(store: SweepStore) -> None:
    record = trained(store, 0, 12, 4, not_finite=8)
    (found,) = comparisons_before(store, spec_of(250, 4), [record]).values()
    assert found == (Comparison(400, 4.0), Comparison(800, None), Comparison(1_200, 12.0))


def test_where_a_trial_was_changed_it_was_compared(store: SweepStore) -> None:
    """As an earlier version compared it there."""
    change = ChangeRecord(
        iteration=5, num_env_steps=500, source_trial_id="t0001", source_iteration=5, before={"lr": 1e-3},
        after={"lr": 2e-3}, time=0.0,
    )  # fmt: skip
    record = trained(store, 0, 9, 1, changes=(change,))
    (found,) = comparisons_before(store, spec_of(300, 1), [record]).values()
    assert [each.num_env_steps for each in found] == [300, 500, 800]


def test_trials_whose_results_are_not_known_are_left_out(store: SweepStore, caplog: pytest.LogCaptureFixture) -> None:
    records = [trained(store, 0, 6, 1), *(trained(store, index, 0, 1, num_env_steps=600) for index in (1, 2))]
    folder = store.trial("t0002").folder
    folder.mkdir(parents=True, exist_ok=True)
    (folder / RESULTS).unlink(missing_ok=True)
    (folder / RESULTS).mkdir()
    assert comparisons_before(store, spec_of(300, 1), records).keys() == {"t0000"}
    assert "t0002: " in caplog.text


def test_results_that_are_ahead_of_all_records_count_and_of_a_new_sweep_none_are_looked_for(store: SweepStore) -> None:
    ahead = trained(store, 0, 6, 1, num_env_steps=0, status="running")
    pending = trained(store, 1, 0, 1, status="pending")
    assert comparisons_before(store, spec_of(300, 1), [pending, ahead]).keys() == {"t0000"}
    store.reading = None  # type: ignore[assignment, method-assign]
    assert comparisons_before(store, spec_of(300, 1), [pending, pending]) == {}


@pytest.mark.parametrize(
    ("places", "changed_at", "made"),
    [
        # Some wait at 600, where all others will be compared with them.
        ({"a": [300, 600], "b": [300]}, {}, {"a": [300], "b": [300]}),
        ({"a": [300], "b": []}, {}, {"a": [], "b": []}),
        ({"a": [300, 600], "b": [300, 600]}, {}, {"a": [300, 600], "b": [300, 600]}),
        ({"a": [], "b": []}, {}, {"a": [], "b": []}),
        # Each at its own evaluations.
        ({"a": [300, 600], "b": [250, 500], "c": [260]}, {"b": 250}, {"a": [300], "b": [250], "c": [260]}),
        # Whoever was changed at the second one was compared with all; the results of one are older.
        (
            {"a": [300, 600], "b": [250, 500], "c": [260]},
            {"b": 500},
            {"a": [300, 600], "b": [250, 500], "c": [260, 600]},
        ),
        # Those that were added have other comparisons behind them.
        ({"a": [300, 600], "b": []}, {}, None),
    ],
)
def test_as_many_comparisons_were_made_as_all_have_behind_them(
    places: dict[str, list[int]], changed_at: dict[str, int], made: dict[str, list[int]] | None
) -> None:
    assert made_together(places, changed_at) == made


def test_selections_are_among_the_comparisons() -> None:
    # Every 240 env steps, at evaluations 100 apart: those of twice as long intervals are not at 500.
    assert [last_over([300, 600, 900, 1_200][:number], 480) for number in range(5)] == [0, 0, 600, 600, 1_200]
    assert last_over(range(250, 1_600, 250), 500) == 1_500

"""The iterations of a sweep in little memory, and all that is made of them as it is of their records."""

import math
import random
import struct
import tracemalloc
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from sweep_folders import make_sweep_folder
from synthetic_sweep import Synthetic, make_sweep

from analysis.best_so_far import best_so_far
from analysis.compact import CompactIterations
from analysis.exports.frames import SweepData, make_frame
from analysis.importance import what_mattered
from analysis.iterations_csv import write_iterations
from analysis.page.bounded import bounded
from analysis.plot_style import MAX_DRAWN
from analysis.records import IterationRecord
from analysis.settings import judge_settings
from analysis.tables import csv_text, iterations_frame, steps_to_solve_frame, trials_frame
from tune_jobs.store.candidates import read_results

Results = Mapping[str, Sequence[IterationRecord]]

METRICS = ("policy_loss", "vf_loss", "entropy", "kl", "lr", "clip_fraction", "grad_norm", "total_loss")


def make_iterations(count: int) -> list[IterationRecord]:
    """Iterations as a trial of PPO has them, none of whose numbers are another's object."""
    rng = random.Random(0)
    return [
        IterationRecord(
            iteration=number,
            num_env_steps=2048 * number,
            num_episodes=10 * number,
            time_s=1.1 * number,
            training_return=rng.random(),
            evaluation_return=rng.random() if number % 5 == 0 else None,
            episode_returns=tuple(rng.random() for _ in range(10)),
            episode_lengths=tuple(rng.randrange(1000, 2000) for _ in range(10)),
            learner={name: rng.random() for name in METRICS},
        )
        for number in range(1, count + 1)
    ]


def odd_iterations() -> list[IterationRecord]:
    """What a file may hold, though no array holds all of it."""
    values: list[dict[str, Any]] = [
        {},
        {"training_return": -0.0, "time_s": math.nan, "learner": {"kl": None, "=loss": math.nan}},
        {"evaluation_return": 5e-324, "episode_lengths": (10**30, -1), "waited_s": math.inf},
        {"episode_returns": (math.nan, -math.inf, 1e308), "learner": {'b, "c"': 1.0, "kl": -math.inf}},
        {"episode_lengths": (2**31,), "learner": {"kl": 0.1, "=loss": None}},
    ]
    known = {"num_env_steps": 2**63 - 1, "num_episodes": 0, "time_s": 1.0}
    return [IterationRecord(iteration=number, **known | given) for number, given in enumerate(values)]


def as_records(items: Sequence[IterationRecord]) -> list[str]:
    """All that is in iterations, to the last bit; NaN is not equal to itself."""
    return [repr({name: getattr(item, name) for name in IterationRecord.model_fields}) for item in items]


@pytest.mark.parametrize("records", [make_iterations(7), odd_iterations(), []], ids=["usual", "odd", "none"])
def test_they_are_what_was_read(records: list[IterationRecord]) -> None:
    compact = CompactIterations(iter(records))
    assert as_records(compact) == as_records(records)
    assert (len(compact), bool(compact)) == (len(records), bool(records))
    for part in (slice(2, None), slice(-2, None), slice(None, None, -1), slice(9, 12)):
        assert as_records(compact[part]) == as_records(records[part])
    places = range(-len(records), len(records))
    assert as_records([compact[place] for place in places]) == as_records([records[place] for place in places])
    for place in (len(records), -len(records) - 1):
        with pytest.raises(IndexError):
            compact[place]


def test_a_copy_has_other_values_and_is_a_record() -> None:
    [record] = make_iterations(1)
    changes = {"evaluation_return": None, "episode_returns": (1.0,)}
    assert CompactIterations([record])[0].model_copy(update=changes) == record.model_copy(update=changes)


def taken(make: Callable[[], object]) -> tuple[int, int]:
    """Return the bytes that something takes when it is made, and the most while it was."""
    make()  # what is imported and cached once doesn't count
    tracemalloc.start()
    try:
        made = make()
        now, peak = tracemalloc.get_traced_memory()
        del made
        return now, peak
    finally:
        tracemalloc.stop()


def test_a_sweep_takes_a_small_part_of_what_its_records_take(tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    for trial_id in store.trial_stamps():
        trial = store.trial(trial_id)
        trial.take()
        trial.keep_iterations(make_iterations(500))
    now, peak = taken(lambda: read_results(store))
    assert now < 2000 * 400
    # Of one trial alone there are records at once, and the lines that they were read from.
    assert peak < 2000 * 2500


def test_iterations_csv_takes_no_memory_that_grows_with_the_sweep(tmp_path: Path) -> None:
    items = CompactIterations(make_iterations(500))
    results = {f"t{index:04d}": items for index in range(40)}
    _, peak = taken(lambda: write_iterations(tmp_path / "iterations.csv", results))
    assert peak < 1_000_000


def floats(count: int) -> list[list[float]]:
    """Floats of all sizes, three by three."""
    rng = random.Random(1)
    return [list(struct.unpack("<3d", rng.randbytes(24))) for _ in range(count)]


def test_iterations_csv_is_what_the_table_is_as_csv(tmp_path: Path) -> None:
    many = [
        IterationRecord(
            iteration=number, num_env_steps=number, num_episodes=0, time_s=first, training_return=second,
            evaluation_return=third, learner={"a": first, "b": third},
        )
        for number, (first, second, third) in enumerate(floats(500))
    ]  # fmt: skip
    results: Results
    for results in ({"t0000": odd_iterations(), "t0001": (), "t0002": many}, {"t0000": []}, {}):
        write_iterations(tmp_path / "iterations.csv", results)
        assert (tmp_path / "iterations.csv").read_bytes() == csv_text(iterations_frame(results)).encode()


@pytest.fixture(scope="module")
def made() -> Synthetic:
    return make_sweep(failed={3}, pending={5}, seeds_per_point=2)


@pytest.fixture(scope="module")
def results(made: Synthetic) -> Results:
    return {trial_id: CompactIterations(items) for trial_id, items in made.results.items()}


def test_tables_and_judgements_of_them_are_those_of_records(made: Synthetic, results: Results) -> None:
    def all_of(known: Results) -> list[Any]:
        data = SweepData(made.trials, known, "final", num_env_steps=50_000, threshold=195.0)
        tables = [make_frame(data, rows) for rows in ("trials", "iterations", "evaluations", "settings")]
        tables += [frame(made.trials, known, threshold=195.0) for frame in (trials_frame, steps_to_solve_frame)]
        return [
            *map(csv_text, tables),
            judge_settings(made.trials, known, num_env_steps=50_000, threshold=195.0, cost="env_steps"),
            what_mattered(made.sweep, made.trials, known),
            [best_so_far(made.trials, known, evaluated=evaluated) for evaluated in (True, False)],
        ]

    assert all_of(results) == all_of(made.results)


@pytest.mark.parametrize("is_evaluated", [True, False])
def test_what_mattered_where_a_scheduler_ended_trials_too(made: Synthetic, *, is_evaluated: bool) -> None:
    """Of these, iterations are cut, and judged without evaluations where some trials have none by then."""
    at = made.results["t0001"][7].num_env_steps
    trials = [
        trial.model_copy(update={"status": "stopped", "num_env_steps": at}) if trial.index == 1 else trial
        for trial in made.trials
    ]
    known = {trial_id: list(items) for trial_id, items in made.results.items()}
    known["t0001"] = known["t0001"][:8]
    if not is_evaluated:
        known["t0002"][:10] = [item.model_copy(update={"evaluation_return": None}) for item in known["t0002"][:10]]
    answer = what_mattered(made.sweep, trials, known)
    assert ("had not been evaluated by then" in " ".join(answer.notes)) is not is_evaluated
    assert what_mattered(made.sweep, trials, {name: CompactIterations(known[name]) for name in known}) == answer


def test_only_numbers_too_large_to_draw_are_made_smaller() -> None:
    usual, odd = CompactIterations(make_iterations(3)), CompactIterations(odd_iterations())
    assert bounded(known := {"t0000": usual}) is known
    found = bounded({"t0000": usual, "t0001": odd})
    assert as_records(found["t0000"]) == as_records(usual)
    assert repr([item.episode_returns for item in found["t0001"]]) == repr(
        [(), (), (), (math.nan, -MAX_DRAWN, MAX_DRAWN), ()]
    )
    rest = [name for name in IterationRecord.model_fields if name != "episode_returns"]
    assert repr([[getattr(item, name) for name in rest] for item in found["t0001"]]) == repr(
        [[getattr(item, name) for name in rest] for item in odd]
    )

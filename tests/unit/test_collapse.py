"""Which trials collapsed, and where that is shown."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from report_sources import setting, settings_of, source_of
from synthetic_sweep import Synthetic, make_sweep

from analysis.collapse import Collapse, collapsed_trials, collapses, collapses_text
from analysis.page import all_trials, cards
from analysis.records import ChangeRecord, IterationRecord, TrialRecord
from analysis.tables import trials_frame, write_csv
from analysis.wording import NONE
from tests.narrowing import present


def curve(evaluations: Sequence[float | None], *, training: Sequence[float | None] = ()) -> list[IterationRecord]:
    returns = [*training, *[None] * (len(evaluations) - len(training))]
    return [
        IterationRecord(
            iteration=index + 1, num_env_steps=100 * (index + 1), num_episodes=10, time_s=1.0,
            evaluation_return=evaluation, training_return=returns[index],
        )
        for index, evaluation in enumerate(evaluations)
    ]  # fmt: skip


def trial(index: int = 0, **given: Any) -> TrialRecord:
    values: dict[str, Any] = {"status": "completed", "point": {"lr": 0.1}, **given}
    return TrialRecord(trial_id=f"t{index:04d}", index=index, point_index=index, seed=index, **values)


def trial_collapsed(one: TrialRecord, iterations: Sequence[IterationRecord]) -> bool | None:
    """Of a trial by itself, which is the one that learnt most."""
    return collapsed_trials([one], {one.trial_id: iterations})[one.trial_id]


COLLAPSED = [20.0, 500.0, 21.0]
HELD = [20.0, 400.0, 500.0]


@pytest.mark.parametrize(
    ("evaluations", "expected"),
    [
        (COLLAPSED, True),
        (HELD, False),
        ([20.0, 120.0, 70.0], False),  # half, and not more
        ([20.0, 120.0, 69.9], True),
        ([-500.0, -100.0, -350.0], True),
        ([-500.0, -100.0, -200.0], False),  # twice as far below zero, but a quarter of what was learnt
        ([-20.0, 5.0, -1.0], False),
        ([7.0, 7.0, 7.0], False),
        ([0.0, 0.0], False),
        ([9.4, 9.3, 9.2], False),  # never above where it began
        ([None, 20.0, None, 500.0, 21.0, None], True),
        ([-1.7e308, 1.7e308, -1.7e308], True),
    ],
)
def test_a_collapse_is_the_loss_of_more_than_half_of_what_was_gained(
    evaluations: list[float | None], expected: bool
) -> None:
    assert trial_collapsed(trial(), curve(evaluations)) is expected


def test_a_trial_that_had_learnt_before_its_first_evaluation_began_at_its_first_training_return() -> None:
    assert trial_collapsed(trial(), curve([500.0, 30.0])) is False  # nothing is known of how it began
    assert trial_collapsed(trial(), curve([500.0, 30.0], training=[22.0])) is True
    assert trial_collapsed(trial(), curve([None, 500.0, 300.0], training=[None, 22.0, 300.0])) is False
    # A first training return that is higher, as exploring does better than the greedy policy, does not count.
    assert trial_collapsed(trial(), curve([-500.0, -100.0, -250.0], training=[-200.0])) is False


def test_it_is_not_known_before_the_end_or_of_fewer_than_two_evaluations() -> None:
    for evaluations in ([], [None, None], [500.0], [None, 500.0, math.nan]):
        assert trial_collapsed(trial(), curve(evaluations, training=[20.0][: len(evaluations)])) is None
    for status in ("pending", "running", "paused"):
        assert trial_collapsed(trial(status=status), curve(COLLAPSED)) is None
    for status in ("stopped", "failed"):
        assert trial_collapsed(trial(status=status), curve(COLLAPSED)) is True


def test_a_trial_that_hardly_learnt_has_little_to_lose() -> None:
    curves = {"t0000": HELD, "t0001": [20.0, 110.0, 20.0], "t0002": [20.0, 116.0, 20.0], "t0003": [20.0, 23.0, 19.0]}
    results = {trial_id: curve(values) for trial_id, values in curves.items()}
    trials = [trial(index) for index in range(4)]
    found = collapsed_trials(trials, results)
    # A fifth of what t0000 gained, 480, is 96.
    assert found == {"t0000": False, "t0001": False, "t0002": True, "t0003": False}
    # Where none of them learnt more, that was the most there was to learn.
    assert collapsed_trials(trials[3:], results) == {"t0003": True}


def test_a_baseline_learns_nothing_that_it_could_lose() -> None:
    assert trial_collapsed(trial(engine="baseline"), curve([20.0, 25.0, 19.0])) is False


def test_a_trial_of_a_population_is_judged_by_its_own_evaluations() -> None:
    change = ChangeRecord(
        iteration=3, num_env_steps=300, source_trial_id="t0001", source_iteration=2, before={"lr": 0.1},
        after={"lr": 0.2}, time=0.0,
    )  # fmt: skip
    member = trial(changes=(change,))
    # It fell, then went on from another's weights, and ended well.
    assert trial_collapsed(member, curve([20.0, 500.0, 21.0, 480.0])) is False
    assert trial_collapsed(member, curve([20.0, 30.0, 25.0, 480.0, 21.0])) is True


def test_the_table_has_a_boolean_that_may_be_missing(tmp_path: Path) -> None:
    trials = [trial(index) for index in range(3)]
    results = {"t0000": curve(COLLAPSED), "t0001": curve(HELD), "t0002": curve([500.0])}
    frame = trials_frame(trials, results)
    assert frame["collapsed"].dtype == "boolean"
    assert frame["collapsed"].tolist() == [True, False, pd.NA]
    assert trials_frame(trials)["collapsed"].isna().all()
    write_csv(tmp_path / "trials.csv", frame)
    lines = (tmp_path / "trials.csv").read_text().splitlines()
    place = lines[0].split(",").index("collapsed")
    assert [line.split(",")[place] for line in lines[1:]] == ["True", "False", ""]


def sweep_of(*curves: Sequence[IterationRecord]) -> Synthetic:
    """A sweep whose first trials have these iterations."""
    synthetic = make_sweep(points=[{"lr": 3e-3}, {"lr": 1.2e-3}], seeds_per_point=3)
    for item, rows in zip(synthetic.trials, curves, strict=False):
        synthetic.results[item.trial_id] = list(rows)
    return synthetic


def test_the_reports_table_has_the_column_and_says_what_it_means_where_a_trial_collapsed() -> None:
    found = all_trials.section(source_of(sweep_of(curve(COLLAPSED), curve([500.0]))))
    place = found.table.headings.index("collapsed")
    cells = {row[1].text: row[place] for row in found.table.rows}
    assert (cells["t0000"].text, cells["t0000"].kind) == ("yes", "collapsed")
    assert (cells["t0001"].text, cells["t0001"].value) == (NONE, None)
    assert (cells["t0002"].text, cells["t0002"].kind) == ("no", "")
    assert "lost more than half of what its best one had gained" in found.collapse_means
    without = all_trials.section(source_of(sweep_of(curve(HELD))))
    assert "collapsed" not in without.table.headings
    assert without.collapse_means == ""


def card_of(synthetic: Synthetic) -> cards.SettingCard:
    best = setting(1, ["t0000", "t0001", "t0002"], 3, probability_best=0.9)
    other = setting(2, ["t0003", "t0004", "t0005"], 3, probability_best=0.1)
    return present(cards.setting_card(source_of(synthetic, settings_of(best, other))))


def test_the_card_of_the_setting_says_which_of_its_trainings_collapsed() -> None:
    card = card_of(sweep_of(curve(HELD), curve(COLLAPSED)))
    assert card.collapsed == "1 of 3 trainings collapsed: t0001 from 500.0 to 21.0 (best and last evaluation)"
    # Another setting's do not count.
    assert card_of(sweep_of(*[curve(HELD)] * 3, curve(COLLAPSED))).collapsed == ""


def test_of_many_collapses_the_first_are_named() -> None:
    assert collapses_text([], 3) == ""
    many = [Collapse(f"t{index:04d}", 10.0, 1.0) for index in range(5)]
    text = collapses_text(many, 20)
    assert text.startswith("5 of 20 trainings collapsed: t0000 from 10.0 to 1.0, t0001 ")
    assert text.endswith("t0002 from 10.0 to 1.0 and 2 more (best and last evaluation)")
    assert collapses(["t0007"], [], {}) == []

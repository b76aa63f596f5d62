"""The values of a population's trials where they are shown: beside a score, those that it was reached with."""

import io
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from test_monitor import make_monitor

from analysis.charts.model import Plots
from analysis.charts.population import make_charts
from analysis.charts.subject import Subject
from analysis.importance import what_mattered
from analysis.page.how_sure import fewest_env_steps
from analysis.plot_style import group_names, numeric_names
from analysis.plots import learning_curves, score_by_lr
from analysis.records import ChangeRecord, CheckpointRecord, IterationRecord, SweepRecord, TrialRecord
from analysis.report_tables import steps_table, trial_table
from analysis.tables import steps_to_solve_frame, trials_frame
from tune_jobs.cli.trials_table import chosen, print_table
from tune_jobs.sweeps.live_table import render, summary_line

UNIFORM: dict[str, Any] = {"lr": 1e-3, "replay": "uniform"}
PRIORITIZED: dict[str, Any] = {"lr": 5e-3, "replay": "prioritized", "prioritized_alpha": 0.3}


def change(iteration: int, before: dict[str, Any], after: dict[str, Any]) -> ChangeRecord:
    return ChangeRecord(
        iteration=iteration, num_env_steps=iteration * 1_000, source_trial_id="t0009", source_iteration=iteration,
        before=before, after=after, time=0.0,
    )  # fmt: skip


def trial(index: int, point: dict[str, Any], *changes: ChangeRecord, best_at: int = 20, **given: Any) -> TrialRecord:
    trial_id = f"t{index:04d}"
    best = CheckpointRecord(
        trial_id=trial_id, iteration=best_at, num_env_steps=best_at * 1_000, evaluation_return=480.0 - index
    )
    values = {
        "status": "completed", "num_iterations": 20, "num_env_steps": 20_000, "checkpoints": (best,),
        "best_evaluation_return": 480.0 - index, **given,
    }  # fmt: skip
    return TrialRecord(
        trial_id=trial_id, index=index, point_index=index, seed=index, point=point, changes=changes, **values
    )


FIRST = trial(0, UNIFORM, change(10, PRIORITIZED, UNIFORM), best_at=10)
"""It scored with prioritized replay, and goes on without."""


def table_of(trials: list[TrialRecord]) -> list[str]:
    console = Console(file=io.StringIO(), width=200, markup=False, highlight=False)
    print_table(console, trials, among=trials, width=200)
    return str(console.file.getvalue()).splitlines()  # type: ignore[attr-defined]


def subject(space: dict[str, Any], trials: list[TrialRecord]) -> Subject:
    sweep = SweepRecord(
        name="s", state="completed", evaluation_seeds=(1,), confirmation_seeds=(2,), num_trials=len(trials),
        created_at=0.0, spec={"scheduler": {"type": "pbt"}, "space": space, "stop": {"num_env_steps": 20_000}},
    )  # fmt: skip
    return Subject(sweep, trials, {}, None, what_mattered(sweep, trials, {}, threshold=None))


@pytest.mark.parametrize("status", ["running", "completed"])
def test_the_live_table_and_the_log_show_those_that_the_best_score_was_reached_with(status: str) -> None:
    monitor = make_monitor(FIRST.model_copy(update={"status": status, "num_env_steps": 15_000}))
    assert "best 480.0 (t0000: lr 0.005, replay prioritized, prioritized_alpha 0.3)" in summary_line(monitor)
    console = Console(file=io.StringIO(), width=200)
    console.print(render(monitor, 200))
    lines = str(console.file.getvalue()).splitlines()  # type: ignore[attr-defined]
    (best,) = (line for line in lines if line.startswith("best so far"))
    assert "480.0  lr 0.005, replay prioritized, prioritized_alpha 0.3  (t0000, at 10,000 env steps)" in best
    (row,) = (line.split() for line in lines if line.split()[1:2] == ["t0000"])
    assert row[2:8] == ["480.0", status, "15,000", "0.005", "prioritized", "0.3"]


def test_the_table_of_trials_shows_those_that_a_score_was_reached_with() -> None:
    trials = [FIRST, trial(1, {**UNIFORM, "lr": 2e-3}), trial(2, UNIFORM, checkpoints=())]
    header, _, *rows = table_of(trials)
    for name, cells in [("lr", ["0.005", "0.002", "0.001"]), ("prioritized_alpha", ["0.3", "", ""])]:
        at = header.index(name)
        assert [row[at : at + len(name) + 3].strip() for row in rows[:3]] == cells
    assert [one.trial_id for one in chosen(trials, "lr", None)] == ["t0002", "t0001", "t0000"]
    # As in trials.csv.
    assert trials_frame(trials)["lr"].tolist() == [0.005, 0.002, 0.001]


def test_the_reports_table_shows_those_that_a_score_was_reached_with_also_if_they_act_in_no_trial_any_more() -> None:
    second = trial(1, PRIORITIZED, change(10, UNIFORM, PRIORITIZED), best_at=10)
    for trials in ([FIRST, second], [FIRST, trial(1, UNIFORM)]):
        table = trial_table(trials, {}, goal=None, best=None, core_seconds={}, errors={})
        assert table.headings[:6] == ["score", "trial", "status", "lr", "replay", "prioritized_alpha"]
        assert [[cell.text for cell in row[1:6:2]] for row in table.rows] == [
            ["t0000", "0.005", "0.3"],
            ["t0001", "0.001", ""],
        ]
        assert trials_frame(trials)["prioritized_alpha"].tolist()[0] == 0.3
        assert steps_table(trials, {}, goal=1.0).headings[:3] == ["lr", "replay", "prioritized_alpha"]


def solving_at(iteration: int, num_iterations: int = 20) -> list[IterationRecord]:
    return [
        IterationRecord(
            iteration=number, num_env_steps=number * 1_000, num_episodes=number * 100, time_s=1.0,
            training_return=200.0 if number >= iteration else 20.0, episode_returns=(200.0,) * 100,
        )
        for number in range(1, num_iterations + 1)
    ]  # fmt: skip


def test_env_steps_to_solve_are_told_with_the_values_that_it_was_solved_with() -> None:
    """Not with the newest ones, nor with those that the best evaluation was reached with."""
    changes = change(10, PRIORITIZED, UNIFORM), change(15, UNIFORM, {**UNIFORM, "lr": 1e-9})
    first = trial(0, {**UNIFORM, "lr": 1e-9}, *changes, best_at=20)
    for iteration, values, lr in [
        (8, "lr 0.005, replay prioritized, prioritized_alpha 0.3", 0.005),
        (10, "lr 0.005, replay prioritized, prioritized_alpha 0.3", 0.005),
        (12, "lr 0.001, replay uniform", 0.001),
        (18, "lr 1e-09, replay uniform", 1e-9),
    ]:
        trials, results = [first, trial(1, UNIFORM)], {"t0000": solving_at(iteration), "t0001": solving_at(30)}
        assert fewest_env_steps(trials, results, 195.0).startswith(f"{values} reaches ")
        (row,) = steps_table(trials, results, goal=195.0).rows
        told = [cell.text for cell in row]
        assert told[:3] == [f"{lr:g}", *(["prioritized", "0.3"] if lr == 0.005 else ["uniform", ""])]
        assert told[-1] == f"{iteration},000"
        assert steps_to_solve_frame(trials, results, threshold=195.0)["lr"].tolist() == [lr, 0.001]


def test_what_acts_in_all_trials_by_now_is_empty_where_it_did_not_when_the_env_was_solved() -> None:
    trials = [trial(0, PRIORITIZED, change(10, UNIFORM, PRIORITIZED)), trial(1, PRIORITIZED)]
    (row,) = steps_table(trials, {"t0000": solving_at(8), "t0001": solving_at(30)}, goal=195.0).rows
    assert [cell.text for cell in row[:3]] == ["0.001", "uniform", ""]


def test_a_trial_that_did_not_solve_has_the_values_of_its_score_beside_it() -> None:
    frame = steps_to_solve_frame([FIRST], {"t0000": solving_at(30)}, threshold=195.0)
    assert frame["lr"].tolist() == trials_frame([FIRST])["lr"].tolist() == [0.005]


def test_figures_have_a_score_at_the_values_that_it_was_reached_with() -> None:
    trials = [FIRST, trial(1, UNIFORM)]
    assert numeric_names(trials) == ["lr"]
    assert group_names(trials, "lr") == ["replay", "prioritized_alpha"]
    axes = score_by_lr(trials).axes[0]
    found = {str(dots.get_label()): np.asarray(dots.get_offsets()).tolist() for dots in axes.collections}
    assert found == {"prioritized · 0.3": [[0.005, 480.0]], "uniform": [[0.001, 479.0]]}
    (line, _) = learning_curves(trials, {"t0000": solving_at(10)}, threshold=195.0).axes[0].lines
    assert line.get_label() == "0.005 · prioritized"


@pytest.mark.parametrize("others_began_with", [0.2, 0.3])
def test_schedules_are_drawn_also_where_all_trials_end_with_the_same_value(others_began_with: float) -> None:
    space = {"clip_param": {"choice": [0.1, 0.2, 0.3]}, "gamma": {"choice": [0.9, 0.99]}}
    first, middle, last = ({"clip_param": clip, "gamma": 0.9} for clip in (others_began_with, 0.3, 0.2))
    trials = [trial(0, last, change(10, first, middle), change(15, middle, last)), trial(1, last)]
    (chart,) = make_charts(subject(space, trials))
    assert isinstance(chart.data, Plots)
    assert [plot.y.name for plot in chart.data.plots] == ["clip_param"]


def test_a_chart_of_schedules_that_is_not_drawn_says_why() -> None:
    space = {"clip_param": {"choice": [0.2, 0.3]}}
    same, other = {"clip_param": 0.2}, {"clip_param": 0.3}
    for trials, why in [
        ([trial(0, same), trial(1, other)], "No trial has gone on from another's copy yet"),
        ([trial(0, same, change(10, same, same)), trial(1, same)], "no copy has changed one"),
    ]:
        (chart,) = make_charts(subject(space, trials))
        assert chart.data is None
        assert why in chart.missing

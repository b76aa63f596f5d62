"""The values of a population's trials where they are shown: beside a score, those that it was reached with."""

import io
from typing import Any

import pytest
from rich.console import Console
from test_monitor import make_monitor

from analysis.charts.model import Plots
from analysis.charts.population import make_charts
from analysis.charts.subject import Subject
from analysis.importance import what_mattered
from analysis.records import ChangeRecord, CheckpointRecord, SweepRecord, TrialRecord
from analysis.report_tables import steps_table, trial_table
from analysis.tables import trials_frame
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

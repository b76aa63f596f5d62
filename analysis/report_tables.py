"""The tables of the report: the text of each cell, the value it sorts by, and its style.

A row is one trial, one combination of the hyperparameters with few values, or one point.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from analysis.best_records import BestRecord
from analysis.points import EMPTY, lacks
from analysis.records import FINISHED, IterationRecord, TrialRecord
from analysis.selection import rank_points
from analysis.tables import (
    groups_frame,
    idle_column,
    point_names,
    shown_point,
    solving_point,
    steps_to_solve_frame,
    trials_frame,
)
from analysis.wording import NONE, is_number, number, return_text

MAX_STEPS_ROWS = 20
"""How many points the table of env steps to solve shows; the CSV file beside the report has them all."""
COLLAPSED = "collapsed"
"""The heading of the column that says which trials collapsed."""
_RETURNS = {"score", "training_return", "best_score", "mean_score"}


class Cell(NamedTuple):
    """One cell of a table."""

    value: Any
    """The value that the column sorts by; None: not known, which is last in any order."""
    text: str
    kind: str = ""
    """CSS class: "winner", "collapsed", a trial status, or "wide" for text that may wrap."""
    href: str = ""
    """Where in the page the cell leads; empty: nowhere."""


@dataclass(frozen=True)
class Table:
    """Headings and rows of equal length; a table without rows is not shown."""

    headings: list[str]
    rows: list[list[Cell]]

    @cached_property
    def numeric(self) -> list[bool]:
        """For each column, whether its known values are numbers, which are aligned to the right."""
        known = [[row[i].value for row in self.rows if row[i].value is not None] for i in range(len(self.headings))]
        return [all(map(is_number, values)) for values in known]


def trial_table(
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    *,
    goal: float | None,
    best: BestRecord | None,
    core_seconds: Mapping[str, float],
    errors: Mapping[str, str],
) -> Table:
    """Return all trials, first those that can win, in the order of the selection; the score is the first column.

    Whether a trial collapsed is a column where any did.

    Args:
        trials: The trials of one sweep.
        results: Iterations by trial id, oldest first.
        goal: The return that counts as solved; None: there is none.
        best: The confirmed winner, which is marked.
        core_seconds: The core-seconds of each trial of which they are known.
        errors: The anchor of the error of each failed trial, where the page has it.
    """
    frame = trials_frame(trials, results, threshold=goal)
    frame["core_seconds"] = frame["trial_id"].map(core_seconds).astype("float64")
    ranked = [item.trial.trial_id for point in rank_points(trials) for item in point.trial_scores]
    order = {trial_id: rank for rank, trial_id in enumerate(ranked)}
    winner = best.checkpoint.trial_id if best is not None else None
    columns = {"score": "score", "trial_id": "trial", "status": "status"}
    names = point_names(trials)
    columns |= {name: name for name in names}
    columns |= {"training_return": "training return"}
    if frame["collapsed"].any():
        columns["collapsed"] = COLLAPSED
    if goal is not None:
        columns["num_env_steps_to_solve"] = "env steps to solve"
    columns |= {"num_env_steps": "env steps", "core_seconds": "core-seconds", "seed": "seed"}
    columns |= {"stop_reason": "ended by"}
    lacking = {trial.trial_id: [name for name in names if lacks(shown_point(trial), name)] for trial in trials}
    rows = []
    for row in sorted(frame.to_dict("records"), key=lambda row: order.get(row["trial_id"], len(order))):
        empty = lacking[row["trial_id"]]
        cells = [_NOTHING if name in empty else _cell(str(name), row[name]) for name in columns]
        if row["trial_id"] == winner:
            cells[1] = cells[1]._replace(kind="winner")
        anchor = errors.get(str(row["trial_id"]))
        cells[2] = cells[2]._replace(kind=str(row["status"]), href="" if anchor is None else f"#{anchor}")
        rows.append(cells)
    return Table(list(columns.values()), rows)


def group_table(
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    names: Sequence[str],
    *,
    goal: float | None,
) -> Table:
    """Return the combinations of some hyperparameters, with which of them solve the env and in how few env steps."""
    if not names:
        return Table([], [])
    frame = groups_frame(trials, results, names, threshold=goal)
    columns = {name: name for name in names} | {"num_trials": "trials", "num_failed": "failed"}
    if goal is not None:
        columns |= {"num_solved": "solved", "min_num_env_steps_to_solve": "fewest env steps to solve"}
    columns |= {"best_score": "best score", "mean_score": "mean score"}
    rows = [
        [_cell(str(name), row[name], is_empty=name in names and row[idle_column(name)]) for name in columns]
        for row in frame.to_dict("records")
    ]
    return Table(list(columns.values()), rows)


def steps_table(
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    *,
    goal: float | None,
) -> Table:
    """Return the points that solve the env with each seed, fewest env steps first; none without a goal."""
    if goal is None:
        return Table([], [])
    frame = steps_to_solve_frame(trials, results, threshold=goal)
    names = point_names(trials)
    seeds: dict[int, list[TrialRecord]] = {}
    for trial in sorted(trials, key=lambda trial: trial.seed_index):
        seeds.setdefault(trial.point_index, []).append(trial)
    rows = []
    for row in frame[frame["num_solved"] > 0].head(MAX_STEPS_ROWS).to_dict("records"):
        members = seeds[row["point_index"]]
        # As the frame has it: seeds of one point have the same values, and a population has one seed a point.
        point = solving_point(members[0], goal, results.get(members[0].trial_id, ()))
        # The frame has a column for each seed of any point; this one may have been given fewer.
        each = ", ".join(_steps_of_seed(row[f"num_env_steps_seed_{trial.seed_index}"], trial) for trial in members)
        rows.append(
            [
                *(_cell(name, row[name], is_empty=lacks(point, name)) for name in names),
                Cell(row["num_solved"], f"{row['num_solved']} of {row['num_seeds']}"),
                _cell("median_num_env_steps", row["median_num_env_steps"]),
                Cell(each, each, "wide"),
            ]
        )
    return Table([*names, "seeds that solve", "median env steps", "env steps of each seed"], rows)


_NOTHING = Cell(None, EMPTY)


def _steps_of_seed(num_env_steps: Any, trial: TrialRecord) -> str:
    """Return the text of one seed's env steps to solve; one that still trains may solve yet."""
    cell = _cell("num_env_steps", num_env_steps)
    if cell.value is not None:
        return cell.text
    return "not solved" if trial.status in FINISHED else "not ended yet"


def _cell(name: str, value: Any, *, is_empty: bool = False) -> Cell:
    import pandas as pd

    if pd.isna(value):
        return _NOTHING if is_empty else Cell(None, NONE)
    if name == "collapsed":
        text = "yes" if value else "no"
        return Cell(text, text, "collapsed" if value else "")
    if name == "seed":  # a name more than a number
        return Cell(value, str(value))
    if name == "core_seconds":
        return Cell(value, f"{value:.1f}")
    return Cell(value, return_text(value) if name in _RETURNS else number(value))

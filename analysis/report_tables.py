"""The tables of the report: the text of each cell, the value it sorts by, and its style.

A row is one trial, one combination of the hyperparameters with few values, or one point.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from analysis.records import BestRecord, IterationRecord, TrialRecord
from analysis.selection import PointScore, rank_points
from analysis.statistics import iqm, mean_with_ci, small_sample_note
from analysis.tables import cell_value, groups_frame, point_names, steps_to_solve_frame, trials_frame
from analysis.wording import NONE, interval_text, is_number, number, return_text
from policies import random_streams

MAX_STEPS_ROWS = 20
"""How many points the table of env steps to solve shows; the CSV file beside the report has them all."""
_ONE_DECIMAL = {"score", "training_return", "time_s", "best_score", "mean_score"}


class Cell(NamedTuple):
    """One cell of a table."""

    value: Any
    """The value that the column sorts by; None: not known, which is last in any order."""
    text: str
    kind: str = ""
    """CSS class: "winner", a trial status, or "wide" for text that may wrap."""


@dataclass(frozen=True)
class Table:
    """Headings and rows of equal length; a table without rows is not shown."""

    headings: list[str]
    rows: list[list[Cell]]

    @property
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
) -> Table:
    """Return all trials, first those that can win, in the order of the selection."""
    frame = trials_frame(trials, results, threshold=goal)
    ranked = [item.trial.trial_id for point in rank_points(trials) for item in point.trial_scores]
    order = {trial_id: rank for rank, trial_id in enumerate(ranked)}
    winner = best.checkpoint.trial_id if best is not None else None
    columns = {"trial_id": "trial", "status": "status"} | {name: name for name in point_names(trials)}
    columns |= {"score": "score", "training_return": "training return"}
    if goal is not None:
        columns["num_env_steps_to_solve"] = "env steps to solve"
    columns |= {"num_env_steps": "env steps", "time_s": "time (s)", "stop_reason": "ended by"}
    rows = []
    for row in sorted(frame.to_dict("records"), key=lambda row: order.get(row["trial_id"], len(order))):
        cells = [_cell(str(name), row[name]) for name in columns]
        if row["trial_id"] == winner:
            cells[0] = cells[0]._replace(kind="winner")
        cells[1] = cells[1]._replace(kind=str(row["status"]))
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
    rows = [[_cell(str(name), row[name]) for name in columns] for row in frame.to_dict("records")]
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
    seeds = [str(name) for name in frame.columns if str(name).startswith("num_env_steps_seed_")]
    rows = []
    for row in frame[frame["num_solved"] > 0].head(MAX_STEPS_ROWS).to_dict("records"):
        each = ", ".join("not solved" if (cell := _cell("", row[name])).value is None else cell.text for name in seeds)
        rows.append(
            [
                *(_cell(name, row[name]) for name in names),
                Cell(row["num_solved"], f"{row['num_solved']} of {row['num_seeds']}"),
                _cell("median_num_env_steps", row["median_num_env_steps"]),
                Cell(each, each, "wide"),
            ]
        )
    return Table([*names, "seeds that solve", "median env steps", "env steps of each seed"], rows)


def point_table(trials: Sequence[TrialRecord]) -> Table:
    """Return the points, best first, if they have several seeds, else an empty table."""
    points = rank_points(trials)
    if all(point.num_seeds < 2 for point in points):
        return Table([], [])
    names = point_names(trials)
    rng = random_streams.fixed()
    headings = ["rank", *names, "seeds usable", "mean score", "IQM", "95 % interval", "note"]
    return Table(headings, [_point_row(rank, point, names, rng) for rank, point in enumerate(points, start=1)])


def _point_row(rank: int, point: PointScore, names: Sequence[str], rng: np.random.Generator) -> list[Cell]:
    scores = [item.score for item in point.trial_scores]
    notes = [] if point.complete else ["seeds missing: ranked after complete points"]
    notes += [note] if (note := small_sample_note(len(scores))) else []
    interval = interval_text(mean_with_ci(scores, rng=rng)) if len(scores) > 1 else NONE
    return [
        Cell(rank, str(rank)),
        *(_cell(name, cell_value(point.point.get(name))) for name in names),
        Cell(len(scores), f"{len(scores)} of {point.num_seeds}"),
        Cell(point.score, return_text(point.score)),
        Cell(iqm(scores), return_text(iqm(scores))),
        Cell(interval, interval),
        Cell("; ".join(notes), "; ".join(notes), "wide"),
    ]


def _cell(name: str, value: Any) -> Cell:
    import pandas as pd

    if pd.isna(value):
        return Cell(None, NONE)
    return Cell(value, return_text(value) if name in _ONE_DECIMAL else number(value))

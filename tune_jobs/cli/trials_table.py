"""The table of a sweep's trials: its columns by importance, as many as fit on the terminal, in the order asked for."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from analysis.points import searched_names, value_text
from analysis.selection import score_trial
from analysis.tables import shown_point
from analysis.wording import PLAIN_NONE, counted, duration, return_text, setting_text
from policies.errors import SpecError
from policies.suggestions import did_you_mean
from tune_jobs.cli.output import (
    STATUS_ORDER,
    STATUS_STYLES,
    first_line,
    make_console,
    print_json,
    print_trial_notes,
)
from tune_jobs.cli.whole_columns import print_left_out, terminal_width
from tune_jobs.sweeps.columns import Fit, fit

if TYPE_CHECKING:
    from rich.console import Console

    from analysis.records import TrialRecord

_GAP = 3
_MAX_FAILURES = 3


@dataclass(frozen=True)
class _Column:
    """One column, and how trials are sorted by it."""

    title: str
    key: Callable[[TrialRecord], Any]
    """What trials are sorted by, smallest first; None and NaN come last."""
    text: Callable[[TrialRecord], str]
    names: tuple[str, ...] = ()
    """Other names of it: those of the records' fields and of trials.csv."""
    justify: Literal["left", "right"] = "left"


def show_trials(
    trials: Sequence[TrialRecord], *, sort: str | None = None, top: int | None = None, as_json: bool
) -> None:
    """Print one line per trial.

    Args:
        trials: The trials, by index.
        sort: The column to sort by; None: by index, or by score if only the first are wanted.
        top: How many to print; None: all.
        as_json: Whether to print whole records as JSON.

    Raises:
        SpecError: There is no such column.
    """
    shown = chosen(trials, sort, top)
    if as_json:
        print_json(shown)
        return
    console = make_console()
    print_table(console, shown, among=trials, width=terminal_width(console), first=sort)
    if len(shown) < len(trials):
        console.print(f"{len(shown):,} of {counted(len(trials), 'trial')}", style="dim")
    print_trial_notes(console, shown)


def chosen(trials: Sequence[TrialRecord], sort: str | None, top: int | None) -> list[TrialRecord]:
    """Return the first `top` trials in the order of a column.

    Raises:
        SpecError: There is no such column.
    """
    if sort is None and top is None:
        return list(trials)
    column = _find(_columns(trials), sort or "score")
    return sorted(trials, key=lambda trial: (*_order(column.key(trial)), trial.index))[:top]


def print_table(
    console: Console,
    trials: Sequence[TrialRecord],
    *,
    among: Sequence[TrialRecord],
    width: int | None,
    first: str | None = None,
) -> None:
    """Print the table of trials.

    Args:
        console: Where to.
        trials: The trials, in their order.
        among: All trials of the sweep, whose values decide which columns there are and which of them matter.
        width: Characters of a line; columns that don't fit are named below the table. None: all columns are shown.
        first: The column that is as important as the trials' ids; None: none is.
    """
    from rich.text import Text

    columns = _columns(among)
    if first is not None:
        wanted = _find(columns, first)
        columns.sort(key=lambda column: (column.title != "trial", column is not wanted))
    rows = [[column.text(trial) for column in columns] for trial in trials]
    fitting = fit([column.title for column in columns], rows, width, gap=_GAP)
    shown = fitting.of(columns)
    # Not a table of rich's, which takes ten seconds for five thousand trials.
    lines = [
        Text(_line([column.title for column in shown], shown, fitting), style="bold"),
        Text(("-" if console.options.ascii_only else "─") * fitting.width),
    ]
    for trial, row in zip(trials, rows, strict=True):
        line = Text(_line(fitting.of(row), shown, fitting))
        start = line.plain.find(trial.status)
        if start >= 0:
            line.stylize(STATUS_STYLES.get(trial.status, ""), start, start + len(trial.status))
        lines.append(line)
    # Lines of a pipe are never wrapped.
    console.print(Text("\n").join(lines), soft_wrap=True)
    missing = [columns[position].title for position in fitting.left_out]
    print_left_out(console, missing)
    if "ended by" in missing:
        _print_failures(console, trials)


def _print_failures(console: Console, trials: Sequence[TrialRecord]) -> None:
    failed = [trial for trial in trials if trial.status == "failed"]
    for trial in failed[:_MAX_FAILURES]:
        console.print(f"{trial.trial_id} failed: {first_line(trial.error)}", style="red")
    if len(failed) > _MAX_FAILURES:
        console.print(f"and {len(failed) - _MAX_FAILURES:,} more failed", style="red")


def _line(cells: Sequence[str], columns: Sequence[_Column], fitting: Fit) -> str:
    from rich.cells import cell_len

    padded = []
    for cell, column, width in zip(cells, columns, fitting.widths, strict=True):
        space = " " * (width - cell_len(cell))
        padded.append(space + cell if column.justify == "right" else cell + space)
    return (" " * _GAP).join(padded).rstrip()


def _columns(trials: Sequence[TrialRecord]) -> list[_Column]:
    """Return the columns of a table of these trials, the most important first."""
    columns = [
        _Column("trial", lambda trial: trial.index, lambda trial: trial.trial_id, ("trial_id", "id", "index")),
        _Column("status", lambda trial: STATUS_ORDER.index(trial.status), lambda trial: trial.status),
        _Column("score", _score_order, _score_text, ("best", "best_evaluation_return"), "right"),
        _Column(
            "env steps",
            lambda trial: trial.num_env_steps,
            lambda trial: f"{trial.num_env_steps:,}",
            ("num_env_steps",),
            "right",
        ),
        *map(_point_column, _names_of_points(trials)),
        _Column("seed", lambda trial: trial.seed, lambda trial: str(trial.seed), justify="right"),
    ]
    if any(trial.changes for trial in trials):
        columns.append(_Column("copied", lambda trial: len(trial.changes), _copied_text, ("changes",)))
    columns += [
        _Column(
            "evaluation",
            lambda trial: _negative(trial.evaluation_return),
            lambda trial: return_text(trial.evaluation_return, none=PLAIN_NONE),
            ("evaluation_return",),
            "right",
        ),
        _Column(
            "training",
            lambda trial: _negative(trial.training_return),
            lambda trial: return_text(trial.training_return, none=PLAIN_NONE),
            ("training_return",),
            "right",
        ),
        _Column(
            "time",
            lambda trial: trial.time_s,
            lambda trial: duration(trial.time_s, none=PLAIN_NONE),
            ("time_s",),
            "right",
        ),
        _Column("ended by", _ended_by, lambda trial: _ended_by(trial) or PLAIN_NONE, ("stop_reason", "error")),
    ]
    if len({trial.engine for trial in trials}) > 1:
        columns.append(_Column("engine", lambda trial: trial.engine, lambda trial: trial.engine))
    return columns


def _find(columns: Sequence[_Column], name: str) -> _Column:
    by_name = {_plain(other): column for column in columns for other in (*column.names, column.title)}
    found = by_name.get(_plain(name))
    if found is not None:
        return found
    titles = [column.title for column in columns]
    suggestion = did_you_mean(name, titles)
    raise SpecError(f"--sort: the trials have no column {name!r}.{suggestion}", f"The columns: {', '.join(titles)}.")


def _plain(name: str) -> str:
    return name.strip().lower().replace("_", " ").replace("-", " ")


def _names_of_points(trials: Sequence[TrialRecord]) -> list[str]:
    """Return the searched hyperparameters, those that differ among these trials first."""
    points = [shown_point(trial) for trial in trials]
    names = searched_names(points)
    values = {name: {value_text(point, name) for point in points} for name in names}
    return sorted(names, key=lambda name: len(values[name]) == 1)


def _point_column(name: str) -> _Column:
    return _Column(name, lambda trial: shown_point(trial).get(name), lambda trial: value_text(shown_point(trial), name))


def _score_order(trial: TrialRecord) -> tuple[float, int] | None:
    # As trials of one seed a point are ranked.
    scored = score_trial(trial)
    return None if scored is None else (-scored.score, scored.checkpoint.num_env_steps)


def _score_text(trial: TrialRecord) -> str:
    scored = score_trial(trial)
    return return_text(None if scored is None else scored.score, none=PLAIN_NONE)


def _ended_by(trial: TrialRecord) -> str | None:
    return first_line(trial.error) if trial.status == "failed" else trial.stop_reason


def _copied_text(trial: TrialRecord) -> str:
    return ", ".join(change.source_trial_id for change in trial.changes) or PLAIN_NONE


def _negative(value: float | None) -> float | None:
    return None if value is None else -value


def _order(value: Any) -> tuple[bool, bool, Any]:
    """Return a key by which values of any kinds are sorted: numbers, then texts, then what is not known."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return (True, True, "")
    if isinstance(value, int | float):
        return (False, False, (value,))
    if isinstance(value, list | tuple) and all(isinstance(item, int | float) for item in value):
        return (False, False, tuple(value))
    return (False, True, setting_text(value))

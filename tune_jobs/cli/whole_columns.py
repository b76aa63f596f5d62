"""Tables of which a terminal shows whole columns: a part of an id can't be used, and a part of a number misleads."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from tune_jobs.cli.output import make_table
from tune_jobs.sweeps.columns import fit

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_GAP = 3
_EDGES = 2


def terminal_width(console: Console) -> int | None:
    """Return how many characters a line of the terminal has; None: standard output is a pipe or a file.

    The console itself would take a pipe for a terminal where FORCE_COLOR is set.
    """
    return console.width if sys.stdout.isatty() else None


def print_whole(console: Console, table: Table, *, least: Sequence[str] = ()) -> None:
    """Print a table without the columns for which a terminal has no room, which are named below it.

    The first column is always there, and cut by a terminal that is narrower still.

    Args:
        console: Where to.
        table: Its cells are texts of one line, its first columns the most important ones.
        least: Titles of columns that are left out before others.
    """
    width = terminal_width(console)
    titles = [str(column.header) for column in table.columns]
    rows = list(zip(*(column.cells for column in table.columns), strict=True))
    order = sorted(range(len(titles)), key=lambda position: titles[position] in least)
    texts = [[str(cells[position]) for position in order] for cells in rows]
    fitting = fit([titles[position] for position in order], texts, None if width is None else width - _EDGES, gap=_GAP)
    shown = sorted(fitting.of(order))
    fitted = make_table(*(titles[position] for position in shown))
    for row, cells in zip(table.rows, rows, strict=True):
        fitted.add_row(*(cells[position] for position in shown), style=row.style)
    if width is None:
        console.width = max(console.width, fitting.width + _EDGES)
    console.print(fitted)
    print_left_out(console, [titles[order[position]] for position in fitting.left_out])


def print_left_out(console: Console, titles: Sequence[str]) -> None:
    """Name the columns that a terminal has no room for; those without a title only draw what others say."""
    named = [title for title in titles if title]
    if named:
        console.print(
            f"Left out, as {console.width} columns are too few: {', '.join(named)}. "
            "To see them, widen the terminal, or add --json.",
            style="dim",
        )

"""Print a comparison: facts side by side, as many as the terminal has room for, and the verdict of each pair."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tune_jobs.cli.output import make_console, print_json, show_paths

if TYPE_CHECKING:
    from rich.console import Console

    from analysis.comparison.compare import Comparison
    from analysis.comparison.repetition import Repetition

_TITLE_WIDTH = 18
_ENTRY_WIDTH = 24


def show_comparison(comparison: Comparison, *, html: str | None, as_json: bool) -> None:
    """Print a comparison.

    Args:
        comparison: What was compared.
        html: The page that was written; None: none was.
        as_json: Whether to print it as JSON.
    """
    from analysis.comparison.wording import pair_lines

    if as_json:
        print_json(comparison)
        return
    console = make_console()
    _print_facts(console, comparison)
    for reason in comparison.not_comparable:
        console.print(f"not comparable: {reason}", style="yellow")
    for verdict, lines in pair_lines(comparison):
        console.print(verdict, style="bold")
        for line in lines:
            console.print(f"  {line}")
    for note in comparison.notes:
        console.print(f"note: {note}", style="dim")
    if html is not None:
        show_paths({"page": Path(html)}, as_json=False)


def _print_facts(console: Console, comparison: Comparison) -> None:
    """Print the facts of all entries, in several tables if they don't fit beside each other."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from analysis.comparison.wording import fact_rows

    rows = fact_rows(comparison)
    at_once = max(1, (console.width - _TITLE_WIDTH) // _ENTRY_WIDTH)
    for start in range(0, len(comparison.entries), at_once):
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        table.add_column("", no_wrap=True)
        for entry in comparison.entries[start : start + at_once]:
            # Nothing is cut: what is longer than a line is wrapped.
            table.add_column(entry.letter, overflow="fold")
        for title, cells in rows:
            # Passed as Text, because rich would read values in brackets as styles.
            table.add_row(Text(title, style="bold"), *(Text(cell) for cell in cells[start : start + at_once]))
        console.print(table)


def show_repetition(found: Repetition, *, as_json: bool) -> None:
    """Print what came of running a trial again."""
    from tune_jobs.sweeps.plain import to_json

    if as_json:
        print_json({**to_json(found), "equal": found.equal})
        return
    console = make_console()
    console.print(found.verdict, style="green" if found.equal else "red")
    for line in found.lines():
        console.print(f"  {line}")

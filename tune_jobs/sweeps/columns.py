"""Choose the columns of a table by their importance and the width of the terminal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

_Item = TypeVar("_Item")


@dataclass(frozen=True)
class Fit:
    """Which columns of a table fit into a width."""

    shown: tuple[int, ...]
    """The positions of the columns that fit, in their order."""
    left_out: tuple[int, ...]
    widths: tuple[int, ...]
    """How many characters each of the shown columns needs."""
    width: int
    """How many characters a line has."""

    def of(self, items: Sequence[_Item]) -> list[_Item]:
        """Return those of a row's items, or of the titles, that are shown."""
        return [items[position] for position in self.shown]


def fit(
    titles: Sequence[str], rows: Sequence[Sequence[str]], width: int | None, *, gap: int, num_always: int = 1
) -> Fit:
    """Choose columns for a width: each in turn, if there is room for its title and for every cell as a whole.

    Args:
        titles: The columns' titles, the most important first.
        rows: The cells of each row.
        width: How many characters a line may have; None: any number.
        gap: How many characters lie between two columns.
        num_always: How many of the first columns are shown whatever the width.
    """
    # Imported here because `columns` is also needed where nothing is printed.
    from rich.cells import cell_len

    length: Callable[[str], int] = cell_len
    widths = [max(length(title), *(length(row[position]) for row in rows), 0) for position, title in enumerate(titles)]
    shown: list[int] = []
    left_out: list[int] = []
    used = 0
    for position, needed in enumerate(widths):
        more = needed + (gap if shown else 0)
        if width is None or position < num_always or used + more <= width:
            shown.append(position)
            used += more
        else:
            left_out.append(position)
    return Fit(tuple(shown), tuple(left_out), tuple(widths[position] for position in shown), used)

"""Score against cost: the settings on their Pareto front, and the cheapest one near the best."""

from __future__ import annotations

from dataclasses import dataclass

from analysis.front_words import about_front, cheapest_near_text, front_rows, interval_text
from analysis.page.scores import score_means
from analysis.page.source import Source
from analysis.points import searched_names, value_text
from analysis.report_tables import Cell, Table
from analysis.tables import cell_value
from analysis.wording import NONE, number, return_text


@dataclass(frozen=True)
class Front:
    """What the section shows."""

    cheapest_near: str
    """The cheapest setting near the best; empty: the sweep doesn't ask for cost, and there is no section."""
    about: list[str]
    table: Table


def section(source: Source) -> Front:
    """Return what the section shows."""
    settings = source.settings
    if settings is None or settings.front is None or settings.num_settings < 2:
        return Front("", [], Table([], []))
    front = settings.front
    several = front.num_undecided is not None
    # A name that does not act in the best setting may act in another.
    names = searched_names(item.point for item, _ in front_rows(front))
    headings = ["env steps", f"score {score_means(settings)}", *(["95 % interval over training seeds"] * several)]
    headings += ["rank by score", *names, "seeds", "on the front"]
    rows = []
    for row in front_rows(front):
        item, told = row
        interval = interval_text(item, NONE)
        cells = [
            Cell(item.num_env_steps, number(round(item.num_env_steps))),
            Cell(item.score, return_text(item.score)),
            *([Cell(interval, interval)] * several),
            Cell(item.rank, str(item.rank)),
        ]
        for name in names:
            told_value = value_text(item.point, name, lambda known: number(cell_value(known)), NONE)
            cells.append(Cell(cell_value(item.point.get(name)), told_value))
        rows.append(
            [*cells, Cell(item.num_seeds, str(item.num_seeds)), Cell(told, told, "" if row.is_on_front else "pending")]
        )
    return Front(cheapest_near_text(front), about_front(front), Table(headings, rows))

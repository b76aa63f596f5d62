"""The interactive charts of the page: plain data here, drawn by `templates/charts.js` and, as files, by `static`."""

from __future__ import annotations

from analysis.charts import cost, front, learning, population, what_mattered
from analysis.charts.model import Chart, to_json
from analysis.charts.static import draw
from analysis.charts.subject import Subject

__all__ = ["Chart", "Subject", "draw", "make_charts", "to_json"]


def make_charts(subject: Subject) -> list[Chart]:
    """Return the charts of a sweep in the order of the page; those without data say why."""
    return [
        *what_mattered.make_charts(subject),
        *front.make_charts(subject),
        *learning.make_charts(subject),
        *population.make_charts(subject),
        *cost.make_charts(subject),
    ]

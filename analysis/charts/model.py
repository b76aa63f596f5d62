"""What a chart of the page is, as plain data: the page's script and the static figures are both drawn from it.

Words: a *chart* has a title, a caption and one or more *plots*; a *place* on an axis of categories is the index of its
label. None in a list of numbers is a gap. Nothing here knows how it is drawn.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from analysis.plot_style import MAX_DRAWN

Section = Literal["front", "mattered", "learning", "cost"]
"""The sections of the page that have charts."""
Number = float | int | None
Ending = Literal["whole", "cut", "unfinished", "failed"]
"""How a trial ended: cut early by a scheduler; unfinished: it still runs; failed: or it has no score."""
Look = Literal["line", "thin", "pale", "dots", "hollow"]
_NUM_DIGITS = 9
_MAX_WHOLE = 1e15
"""Whole numbers below it keep all of their digits, as in the tables."""


@dataclass(frozen=True)
class Axis:
    """One axis."""

    name: str
    """What it shows, with its unit."""
    kind: Literal["value", "log", "category"] = "value"
    labels: tuple[str, ...] = ()
    """The categories."""
    low: Number = None
    """Where it begins; None: where the data do."""
    high: Number = None


@dataclass(frozen=True)
class Column:
    """A searched hyperparameter as an axis, with the value of each trial: a number, or the place of its label."""

    axis: Axis
    values: tuple[Number, ...]

    @cached_property
    def ends(self) -> tuple[float, float]:
        """The least and the greatest value, or the first and the last place."""
        if self.axis.kind == "category":
            return 0.0, len(self.axis.labels) - 1.0
        known = [value for value in self.values if value is not None] or [0.0]
        return float(min(known)), float(max(known))


@dataclass(frozen=True)
class Trials:
    """The trials of a sweep, column by column, the most important hyperparameter first."""

    ids: tuple[str, ...]
    score: Axis
    scores: tuple[Number, ...]
    endings: tuple[Ending, ...]
    columns: tuple[Column, ...]
    shown: tuple[int, ...]
    """The indices of those that are drawn; the others are left out where they are too many."""


@dataclass(frozen=True)
class Line:
    """One series of a plot, with a band around it where it has `lower` and `upper`."""

    name: str
    color: str
    """Name of a colour in `plot_style.CSS_LIGHT`, without its dashes."""
    x: tuple[Number, ...]
    y: tuple[Number, ...]
    lower: tuple[Number, ...] = ()
    upper: tuple[Number, ...] = ()
    look: Look = "line"
    is_stepped: bool = False
    texts: tuple[str, ...] = ()
    """What is said of each place, beside its numbers."""


@dataclass(frozen=True)
class Plot:
    """Lines on two axes."""

    x: Axis
    y: Axis
    lines: tuple[Line, ...]
    title: str = ""
    goal: Number = None
    """The return to reach, a dashed line."""


@dataclass(frozen=True)
class Plots:
    """One plot, or several small ones side by side."""

    plots: tuple[Plot, ...]
    kind: Literal["plots"] = "plots"


@dataclass(frozen=True)
class Panels:
    """A small plot of the score for each hyperparameter, coloured by the first of them."""

    trials: Trials
    kind: Literal["panels"] = "panels"


@dataclass(frozen=True)
class Parallel:
    """A line through all hyperparameters for each trial, coloured by its score."""

    trials: Trials
    kind: Literal["parallel"] = "parallel"


@dataclass(frozen=True)
class Cell:
    """A cell of a heat map."""

    x: int
    y: int
    mean: float
    count: int
    best: float


@dataclass(frozen=True)
class HeatMap:
    """Mean scores by two hyperparameters, whose axes are of categories."""

    x: Axis
    y: Axis
    score: Axis
    cells: tuple[Cell, ...]
    kind: Literal["heat_map"] = "heat_map"


@dataclass(frozen=True)
class Bar:
    """A trial's time in a row of a timeline."""

    row: int
    start: float
    end: float
    status: str
    color: str
    text: str


@dataclass(frozen=True)
class Timeline:
    """Bars in rows, over time."""

    x: Axis
    y: Axis
    bars: tuple[Bar, ...]
    kind: Literal["timeline"] = "timeline"


Data = Plots | Panels | Parallel | HeatMap | Timeline


@dataclass(frozen=True)
class Chart:
    """One chart of the page."""

    id: str
    """Its name in the page, and its figure's file name without the suffix."""
    section: Section
    title: str
    caption: str
    """One sentence: what it shows."""
    data: Data | None
    """None: `missing` says why there is none."""
    missing: str = ""
    notes: tuple[str, ...] = ()
    """What else the reader has to know: what was left out, and why."""


def drawable(value: Number) -> Number:
    """Return a finite number that axes can be drawn to; None for NaN and infinity."""
    if value is None or not math.isfinite(value):
        return None
    return max(-MAX_DRAWN, min(MAX_DRAWN, value))


def to_json(charts: Sequence[Chart], colors: dict[str, dict[str, str]]) -> str:
    """Return the charts as JSON that may stand in a `<script>` element of any page.

    Args:
        charts: The charts; those without data are left out.
        colors: The colours of the light and the dark theme, by name.
    """
    tables = [chart.data.trials for chart in charts if isinstance(chart.data, Panels | Parallel)]
    document = {
        "colors": colors,
        "trials": _plain(tables[0]) if tables else None,
        "charts": [
            {"id": chart.id, "title": chart.title, **_plain(chart.data, without=("trials",))}
            for chart in charts
            if chart.data is not None
        ],
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False)
    # Within an element, HTML knows no escapes but looks for "</script" and "<!--"; both begin with this letter. The
    # other two would be ends of lines to old readers of JavaScript.
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _plain(value: Any, without: Sequence[str] = ()) -> Any:
    """Return dataclasses as dicts, without fields that have their defaults, and floats with nine digits."""
    if dataclasses.is_dataclass(value):
        return {
            field.name: _plain(getattr(value, field.name))
            for field in dataclasses.fields(value)
            if field.name not in without and (field.name == "kind" or getattr(value, field.name) != field.default)
        }
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        # Counts are floats, too, where they come from arrays.
        if value.is_integer() and abs(value) < _MAX_WHOLE:
            return int(value)
        finite = drawable(value)
        return None if finite is None else float(f"{finite:.{_NUM_DIGITS}g}")
    return value

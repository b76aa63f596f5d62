"""Draw charts as matplotlib figures: the files beside the page, and what it shows without scripts."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from analysis.charts.columns import place
from analysis.charts.model import (
    Axis,
    Chart,
    Column,
    Ending,
    HeatMap,
    Number,
    Panels,
    Parallel,
    Plot,
    Plots,
    Timeline,
    Trials,
)
from analysis.plot_style import CSS_LIGHT, INK, MUTED, PALETTE, RAMP, escape, goal_line, new_figure, style_axes
from analysis.wording import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

_WIDTH = 9.0
_PALE = 0.12
_COLUMNS = 3
_PANEL_HEIGHT = 2.9
_LABEL_CHARS = 24
_MAX_TICKS = 16
_MAX_ROW_TICKS = 24
_CROWDED = 40
"""Characters that the labels beneath a panel have side by side at most."""
_KEY_COLUMNS = 4
_HATCHED: dict[Ending, str] = {
    "cut": "cut early by a scheduler",
    "unfinished": "not ended yet",
    "failed": "without a score",
}


def draw(chart: Chart) -> Figure:
    """Draw a chart that has data.

    Raises:
        ValueError: It has none.
    """
    data = chart.data
    if isinstance(data, Plots):
        return _draw_plots(data)
    if isinstance(data, Panels):
        return _draw_panels(data.trials)
    if isinstance(data, Parallel):
        return _draw_parallel(data.trials)
    if isinstance(data, HeatMap):
        return _draw_heat_map(data)
    if isinstance(data, Timeline):
        return _draw_timeline(data)
    raise ValueError(f"chart {chart.id} has no data: {chart.missing}")


def _grid(num: int, height: float, legend_rows: int = 0) -> tuple[Figure, list[Axes]]:
    columns = min(num, _COLUMNS)
    rows = math.ceil(num / columns)
    figure = new_figure((_WIDTH, height * rows + 0.2 * legend_rows))
    axes = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for unused in axes[num:]:
        unused.remove()
    return figure, axes[:num]


def _draw_plots(data: Plots) -> Figure:
    labels = list(dict.fromkeys(line.name for plot in data.plots for line in plot.lines))
    figure, all_axes = _grid(len(data.plots), 4.2 if len(data.plots) == 1 else _PANEL_HEIGHT, len(labels))
    for plot, axes in zip(data.plots, all_axes, strict=True):
        _draw_plot(plot, axes)
    found = [pair for axes in all_axes for pair in zip(*axes.get_legend_handles_labels(), strict=True)]
    handles = {label: handle for handle, label in found}
    _legend(figure, list(handles.values()), list(handles))
    return figure


def _draw_plot(plot: Plot, axes: Axes) -> None:
    # Before anything is drawn: on a logarithmic axis matplotlib finds other limits.
    _scale(axes, plot.x, vertical=False)
    _scale(axes, plot.y, vertical=True)
    style_axes(axes, xlabel=escape(plot.x.name), ylabel=escape(plot.y.name), title=escape(plot.title))
    known: set[str] = set()
    for line in plot.lines:
        label = "" if line.name in known else escape(line.name)
        known.add(line.name)
        color, x, y = CSS_LIGHT[f"--{line.color}"], _array(line.x), _array(line.y)
        if line.look in ("dots", "hollow"):
            face = "none" if line.look == "hollow" else color
            axes.plot(x, y, "o", ms=4, markerfacecolor=face, markeredgecolor=color, label=label, zorder=3)
            continue
        width, alpha = {"line": (2.2, 1.0), "thin": (0.8, 0.5), "pale": (0.8, 0.35)}[line.look]
        style = "steps-post" if line.is_stepped else "default"
        # A trial of one iteration is a line without length, so a dot marks it.
        marker = "." if np.isfinite(x).sum() == 1 else ""
        axes.plot(x, y, color=color, lw=width, alpha=alpha, drawstyle=style, label=label, marker=marker, zorder=2)
        if line.lower:
            step: Literal["post"] | None = "post" if line.is_stepped else None
            axes.fill_between(x, _array(line.lower), _array(line.upper), color=color, alpha=0.16, lw=0, step=step)
    goal_line(axes, plot.goal)
    # After everything is drawn: an end that is set stops matplotlib from finding the other.
    axes.set_xlim(plot.x.low, plot.x.high)
    axes.set_ylim(plot.y.low, plot.y.high)


def _draw_panels(trials: Trials) -> Figure:
    handles, labels = _panel_keys(trials)
    figure, all_axes = _grid(len(trials.columns), _PANEL_HEIGHT, math.ceil(len(labels) / _KEY_COLUMNS))
    colors = _colors(trials.columns[0])
    for column, axes in zip(trials.columns, all_axes, strict=True):
        _scale(axes, column.axis, vertical=False)
        style_axes(axes, xlabel=escape(column.axis.name), ylabel=escape(trials.score.name.partition(",")[0]))
        _panel_dots(trials, column, axes, colors)
    if trials.columns[0].axis.kind != "category":
        _color_bar(figure, all_axes, trials.columns[0])
    _legend(figure, handles, [escape(label) for label in labels], columns=_KEY_COLUMNS)
    return figure


def _panel_keys(trials: Trials) -> tuple[list[Any], list[str]]:
    """Return the marks of the legend with their texts; categories that share a colour are one of them."""
    handles, labels = _ending_handles(trials)
    axis = trials.columns[0].axis
    names = [f"{axis.name} {label}" for label in axis.labels[: len(PALETTE)]]
    if num_others := len(axis.labels) - len(names):
        names.append(counted(num_others, "other value"))
    return [_dot(_category_color(index), filled=True) for index in range(len(names))] + handles, names + labels


def _panel_dots(trials: Trials, column: Column, axes: Axes, colors: Sequence[Any]) -> None:
    known = [index for index in trials.shown if column.values[index] is not None]
    is_category = column.axis.kind == "category"
    places = _array([column.values[index] for index in known])
    if is_category:
        places += [jitter(index) for index in known]
    scores = _array([trials.scores[index] for index in known])
    for place_on_axis in places[np.isnan(scores)]:
        transform = axes.get_xaxis_transform()
        axes.plot([place_on_axis], [0.02], "x", ms=5, color=MUTED, transform=transform, clip_on=False)
    edges = [colors[index] for index in known]
    faces = [colors[index] if trials.endings[index] == "whole" else "none" for index in known]
    axes.scatter(places, scores, s=16, facecolors=faces, edgecolors=edges, linewidths=1.0, zorder=3)


def jitter(index: int) -> float:
    """Return how far from the middle of its category a trial is drawn: spread evenly, and the same each time."""
    return 0.6 * ((index * 0.618034) % 1.0 - 0.5)


def _draw_parallel(trials: Trials) -> Figure:
    from matplotlib.collections import LineCollection

    figure = new_figure((_WIDTH, 4.2))
    axes = figure.subplots()
    columns = [*trials.columns, Column(trials.score, trials.scores)]
    score = columns[-1]
    drawn = [index for index in trials.shown if trials.scores[index] is not None]
    drawn.sort(key=lambda index: trials.scores[index] or 0.0)
    known = [[(at, each, each.values[index]) for at, each in enumerate(columns)] for index in drawn]
    lines = [[(at, place(each, value)) for at, each, value in line if value is not None] for line in known]
    steps = [list(itertools.pairwise(line)) for line in lines]
    # Over the axis of what does not act in its trial, a line is pale.
    runs = [[[one, two] for one, two in line if two[0] - one[0] == 1] for line in steps]
    gaps = [[[one, two] for one, two in line if two[0] - one[0] > 1] for line in steps]
    styles = ["-" if trials.endings[index] == "whole" else "--" for index in drawn]
    paints = [_ramp(place(score, score.values[index])) for index in drawn]
    for parts, alpha in ((gaps, _PALE), (runs, 0.6)):
        axes.add_collection(
            LineCollection(
                [part for line in parts for part in line],
                colors=[paint for line, paint in zip(parts, paints, strict=True) for _ in line],
                linestyles=[style for line, style in zip(parts, styles, strict=True) for _ in line],
                linewidths=0.8,
                alpha=alpha,
            )
        )
    axes.set_xlim(-0.2, len(columns) - 0.8)
    axes.set_ylim(-0.05, 1.05)
    style_axes(axes, xlabel="", ylabel="")
    axes.set_yticks([])
    names = [f"{column.axis.name.partition(',')[0]}\n{_ends(column)}" for column in columns]
    axes.set_xticks(range(len(columns)), [escape(name) for name in names], fontsize=8)
    _color_bar(figure, [axes], score)
    return figure


def _ends(column: Column) -> str:
    if column.axis.kind == "category":
        return " · ".join(label[:_LABEL_CHARS] for label in column.axis.labels[:6])
    known = [value for value in column.values if value is not None]
    return f"{min(known):.3g} to {max(known):.3g}{', log' if column.axis.kind == 'log' else ''}"


def _draw_heat_map(data: HeatMap) -> Figure:
    figure = new_figure((_WIDTH, 4.2))
    axes = figure.subplots()
    grid = np.full((len(data.y.labels), len(data.x.labels)), np.nan)
    for cell in data.cells:
        grid[cell.y, cell.x] = cell.mean
    image = axes.imshow(grid, cmap=_color_map(), aspect="auto", origin="lower")
    low, high = float(np.nanmin(grid)), float(np.nanmax(grid))
    for cell in data.cells:
        dark = high > low and (cell.mean - low) / (high - low) < 0.6
        text = f"{cell.mean:.4g}\n({cell.count})"
        axes.text(cell.x, cell.y, text, ha="center", va="center", fontsize=8, color="white" if dark else INK)
    style_axes(axes, xlabel=escape(data.x.name), ylabel=escape(data.y.name))
    axes.grid(visible=False)
    for axis, labels in ((axes.xaxis, data.x.labels), (axes.yaxis, data.y.labels)):
        axis.set_ticks(range(len(labels)), [escape(label[:_LABEL_CHARS]) for label in labels], fontsize=8)
    _add_color_bar(figure, image, [axes], f"mean of {data.score.name.partition(',')[0]} (number of trials)")
    return figure


def _draw_timeline(data: Timeline) -> Figure:
    rows = len(data.y.labels)
    figure = new_figure((_WIDTH, min(9.0, 1.6 + 0.16 * rows)))
    axes = figure.subplots()
    for bar in data.bars:
        width, color = max(bar.end - bar.start, 1e-9), CSS_LIGHT[f"--{bar.color}"]
        axes.barh(bar.row, width, left=bar.start, height=0.8, color=color)
    style_axes(axes, xlabel=escape(data.x.name), ylabel=escape(data.y.name))
    shown = _spread(rows, _MAX_ROW_TICKS)
    axes.set_yticks(shown, [escape(data.y.labels[row]) for row in shown], fontsize=8)
    axes.invert_yaxis()
    statuses = dict.fromkeys((bar.status, bar.color) for bar in data.bars)
    handles = [_dot(CSS_LIGHT[f"--{color}"], filled=True) for _, color in statuses]
    _legend(figure, handles, [status for status, _ in statuses], columns=4)
    return figure


def _scale(axes: Axes, axis: Axis, *, vertical: bool) -> None:
    own = axes.yaxis if vertical else axes.xaxis
    set_limits = axes.set_ylim if vertical else axes.set_xlim
    if axis.kind == "category":
        shown = _spread(len(axis.labels), _MAX_TICKS)
        texts = [axis.labels[index][:_LABEL_CHARS] for index in shown]
        is_turned = not vertical and sum(map(len, texts)) > _CROWDED
        own.set_ticks(shown, [escape(text) for text in texts], fontsize=8, rotation=90 if is_turned else 0)
        set_limits(-0.5, len(axis.labels) - 0.5)
    elif axis.kind == "log":
        (axes.set_yscale if vertical else axes.set_xscale)("log")
    if axis.kind == "value":
        from matplotlib.ticker import EngFormatter, MaxNLocator

        own.set_major_locator(MaxNLocator(6))
        if "env steps" in axis.name:
            own.set_major_formatter(EngFormatter(sep=""))


def _spread(num: int, most: int) -> list[int]:
    """Return the places of so many categories, or as many of them as have room for labels, spread evenly."""
    return sorted(set(np.linspace(0, num - 1, min(num, most)).round().astype(int).tolist()))


def _array(values: Sequence[Number]) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)


def _colors(column: Column) -> list[Any]:
    """Return the colour of each trial by one hyperparameter: of categories, else along the ramp."""
    if column.axis.kind == "category":
        return [_category_color(None if value is None else int(value)) for value in column.values]
    return [MUTED if value is None else _ramp(place(column, value)) for value in column.values]


def _category_color(index: int | None) -> str:
    return MUTED if index is None or index >= len(PALETTE) else PALETTE[index]


@cache
def _color_map() -> Any:
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("ramp", list(RAMP))


def _ramp(share: float) -> Any:
    return _color_map()(share)


def _color_bar(figure: Figure, axes: Sequence[Axes], column: Column) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm, Normalize

    known = [value for value in column.values if value is not None]
    norm = (LogNorm if column.axis.kind == "log" else Normalize)(min(known), max(known))
    _add_color_bar(figure, ScalarMappable(norm, _color_map()), axes, escape(column.axis.name.partition(",")[0]))


def _add_color_bar(figure: Figure, colors: ScalarMappable, axes: Sequence[Axes], label: str) -> None:
    bar = figure.colorbar(colors, ax=list(axes))
    # In colours that the page's dark theme replaces.
    bar.set_label(label, color=INK)
    bar.ax.tick_params(colors=INK, which="both")


def _ending_handles(trials: Trials) -> tuple[list[Any], list[str]]:
    found = [ending for ending in _HATCHED if ending in trials.endings]
    return [_dot(MUTED, filled=False, cross=ending == "failed") for ending in found], [_HATCHED[item] for item in found]


def _dot(color: str, *, filled: bool, cross: bool = False) -> Any:
    from matplotlib.lines import Line2D

    marker = "x" if cross else "o"
    return Line2D([], [], marker=marker, ls="", markeredgecolor=color, markerfacecolor=color if filled else "none")


def _legend(figure: Figure, handles: Sequence[Any], labels: Sequence[str], columns: int = 1) -> None:
    if handles:
        figure.legend(
            handles, labels, loc="outside lower left", ncols=columns, frameon=False, labelcolor=INK, fontsize=8
        )

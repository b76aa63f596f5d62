"""What all figures share: colours, grouping of trials, and SVG that follows the page's light or dark theme.

Figures are built with matplotlib's object interface alone: no pyplot, so no global state and no display.
"""

from __future__ import annotations

import html
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.records import TrialRecord
from analysis.tables import cell_value, point_names
from analysis.wording import is_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK = "#24292f"
"""Text and axes."""
MUTED = "#8b949e"
"""What is there for context: trials of no group, failed trials."""
GRID = "#d8dee4"
ACCENT = "#c2410c"
"""The goal line."""
# Okabe & Ito's colours, told apart with any colour vision; their yellow is left out, as it vanishes on white.
PALETTE = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
MARKERS = ("o", "s", "^", "D", "v", "P")
LINES = ("-", "--", "-.", ":")
_MAX_GROUP_VALUES = len(PALETTE)
_MAX_DRAWN = 1e100
_CSS_NAMES = {INK: "ink", MUTED: "muted", GRID: "grid", ACCENT: "accent"} | {
    color: f"series-{i}" for i, color in enumerate(PALETTE)
}
CSS_LIGHT = {f"--{name}": color for color, name in _CSS_NAMES.items()}
CSS_DARK = CSS_LIGHT | {
    "--ink": "#e6edf3",
    "--muted": "#7d8590",
    "--grid": "#30363d",
    "--accent": "#fb923c",
    "--series-0": "#4da3e0",
    "--series-5": "#ff7b45",
}


@dataclass(frozen=True)
class Style:
    """How the trials of one group look."""

    label: str
    color: str
    marker: str
    line: str


def escape(text: str) -> str:
    """Text as matplotlib must be given it: a pair of dollar signs would be read as a formula."""
    return text.replace("$", r"\$")


def numeric_names(trials: Sequence[TrialRecord]) -> list[str]:
    """Searched hyperparameters that can be an axis: numbers of at least two values, lr first."""
    names = []
    for name in point_names(trials):
        values = {trial.point[name] for trial in trials if is_number(trial.point.get(name))}
        if len(values) > 1:
            names.append(name)
    return sorted(names, key=lambda name: name != "lr")


def group_names(trials: Sequence[TrialRecord], axis: str | None) -> list[str]:
    """Up to two searched hyperparameters to tell trials apart by: of few values, other than the axis."""
    names = []
    for name in point_names(trials):
        values = {cell_value(trial.point.get(name)) for trial in trials}
        if name != axis and 1 < len(values) <= _MAX_GROUP_VALUES:
            names.append(name)
    return names[:2]


def group_styles(trials: Sequence[TrialRecord], names: Sequence[str]) -> dict[str, Style]:
    """A style for each trial id: colour by combination of values, marker by the first, line by the last.

    Without names all trials share one style with an empty label.
    """
    if not names:
        return {trial.trial_id: Style("", PALETTE[0], MARKERS[0], LINES[0]) for trial in trials}
    keys = {t.trial_id: tuple(cell_value(t.point.get(name)) for name in names) for t in trials}
    first = list(dict.fromkeys(key[0] for key in keys.values()))
    last = list(dict.fromkeys(key[-1] for key in keys.values()))
    styles = {
        key: Style(
            label=" · ".join(str(value) for value in key),
            color=PALETTE[number % len(PALETTE)],
            marker=MARKERS[first.index(key[0]) % len(MARKERS)],
            line=LINES[last.index(key[-1]) % len(LINES)],
        )
        for number, key in enumerate(dict.fromkeys(keys.values()))
    }
    return {trial_id: styles[key] for trial_id, key in keys.items()}


def new_figure(size: tuple[float, float]) -> Figure:
    """An empty figure, inches, that lays itself out."""
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained", facecolor="white")


def style_axes(axes: Axes, *, xlabel: str, ylabel: str, title: str = "") -> None:
    """Labels, a light grid, and no box around the data."""
    axes.set_xlabel(xlabel, color=INK)
    axes.set_ylabel(ylabel, color=INK)
    if title:
        axes.set_title(title, color=INK, fontsize=11, loc="left")
    axes.grid(visible=True, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=INK, which="both", length=0)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.spines["bottom"].set_color(MUTED)


def steps_axis(axes: Axes) -> None:
    """A horizontal axis of env steps from 0, with short numbers."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _short(value)))


def _short(value: float) -> str:
    """12000 as "12k", 1500000 as "1.5M"."""
    for unit, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= unit:
            return f"{value / unit:g}{letter}"
    return f"{value:g}"


def drawable(values: ArrayLike) -> NDArray[np.float64]:
    """Finite values as matplotlib can place them: near the largest of floats its axes overflow."""
    return np.clip(np.asarray(values, dtype=np.float64), -_MAX_DRAWN, _MAX_DRAWN)


def goal_line(axes: Axes, threshold: float | None) -> None:
    """The return to reach, dashed; nothing if there is none."""
    if threshold is not None:
        axes.axhline(
            float(drawable([threshold])[0]),
            color=ACCENT,
            linewidth=1.6,
            linestyle=(0, (6, 3)),
            label=f"goal {threshold:g}",
            zorder=1.5,
        )


def add_legend(
    figure: Figure, axes: Axes, names: Sequence[str], size: tuple[float, float], *, below: bool = False
) -> None:
    """Beside a wide figure, below a narrow one or where asked; never over the data."""
    handles, labels = axes.get_legend_handles_labels()
    if not handles:
        return
    narrow = size[0] < 6
    legend = figure.legend(
        handles,
        labels,
        title=escape(" · ".join(names)) or None,
        title_fontproperties={"size": 9, "weight": "bold"},
        loc="outside lower left" if narrow or below else "outside right upper",
        ncols=2 if narrow else 4 if below else 1,
        frameon=False,
        labelcolor=INK,
        fontsize=9,
        alignment="left",
    )
    legend.get_title().set_color(INK)


def to_png(figure: Figure, *, dpi: int = 160) -> bytes:
    """The figure as PNG on white."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def to_svg(figure: Figure, *, label: str, prefix: str) -> str:
    """The figure as an `<svg>` element for a page, transparent, with colours the page may override.

    Every colour of this module becomes `var(--name, #rrggbb)`: the page's theme sets the variables
    (`CSS_LIGHT`, `CSS_DARK`) and the picture is right without them.

    Args:
        figure: What to draw.
        label: What a screen reader says.
        prefix: Put before every id, or two figures in one page would take each other's clip paths.
    """
    import matplotlib as mpl

    buffer = io.StringIO()
    # Letters as shapes: they look the same whatever fonts the reader has. The salt makes the ids
    # reproducible.
    with mpl.rc_context({"svg.fonttype": "path", "svg.hashsalt": prefix}):
        figure.savefig(buffer, format="svg", transparent=True)
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    # The metadata hold the date: the same figure is the same text.
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    # Comments hold label texts, which come from spec files and errors: nothing of theirs is passed through.
    svg = re.sub(r"<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\1{prefix}-", svg)
    for color, name in _CSS_NAMES.items():
        svg = svg.replace(f": {color}", f": var(--{name}, {color})")
    return svg.replace("<svg ", f'<svg role="img" aria-label="{html.escape(label)}" ', 1)

"""Style shared by all figures: colours, grouping of trials, and SVG that follows the page's light or dark theme.

Figures are built with matplotlib's object interface, not with pyplot, so there is no global state and no display.
"""

from __future__ import annotations

import contextlib
import html
import io
import math
import re
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.points import EMPTY, lacks
from analysis.records import TrialRecord
from analysis.tables import cell_value, point_names, shown_point
from analysis.wording import is_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK = "#24292f"
"""The colour of text and axes."""
MUTED = "#8b949e"
"""The colour of trials shown for context: those without a group, and failed ones."""
GRID = "#d8dee4"
ACCENT = "#c2410c"
"""The colour of the goal line."""
# Okabe & Ito's colours, which can be told apart with any colour vision; yellow is left out, as it is faint on white.
PALETTE = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
RAMP = ("#440154", "#3e4989", "#26828e", "#35b779", "#7ad151")
"""The colours of numbers from low to high: viridis without its yellow, which is faint on white."""
_DARK_RAMP = ("#31688e", "#21918c", "#35b779", "#90d743", "#fde725")
MARKERS = ("o", "s", "^", "D", "v", "P")
LINES = ("-", "--", "-.", ":")
_MAX_GROUP_VALUES = len(PALETTE)
MAX_DRAWN = 1e100
_DPI_OF_SVG = 72
_FONTS = ("font.", "mathtext.", "text.latex.", "text.usetex")
_OF_THE_PROCESS = ("backend", "date.epoch", "interactive", "tk.", "toolbar", "webagg.")
"""Settings of matplotlib that no figure is drawn by."""
_styled = threading.RLock()
"""Held by the thread that has changed matplotlib's settings, which are the process's."""
_CSS_NAMES = {INK: "ink", MUTED: "muted", GRID: "grid", ACCENT: "accent"} | {
    color: f"series-{i}" for i, color in enumerate(PALETTE)
}
CSS_LIGHT = {
    "--page": "#f6f8fa",
    "--card": "#ffffff",
    "--chip": "#eef1f4",
    "--soft": "#59636e",
    "--link": "#0969da",
    "--good": "#1a7f37",
    **{f"--{name}": color for color, name in _CSS_NAMES.items()},
    **{f"--ramp-{i}": color for i, color in enumerate(RAMP)},
}
"""The colours of the page in its light theme."""
CSS_DARK = CSS_LIGHT | {
    "--page": "#0d1117",
    "--card": "#151b23",
    "--chip": "#212830",
    "--soft": "#9198a1",
    "--link": "#4493f8",
    "--good": "#3fb950",
    "--ink": "#e6edf3",
    "--muted": "#7d8590",
    "--grid": "#30363d",
    "--accent": "#fb923c",
    "--series-0": "#4da3e0",
    "--series-5": "#ff7b45",
    **{f"--ramp-{i}": color for i, color in enumerate(_DARK_RAMP)},
}


@dataclass(frozen=True)
class Style:
    """The look of the trials of one group."""

    label: str
    color: str
    marker: str
    line: str


def escape(text: str) -> str:
    """Escape text for matplotlib: a pair of dollar signs is a formula there, a label that begins with "_" is hidden."""
    # A space of no width: the name is as it is.
    return ("\u200b" if text.startswith("_") else "") + text.replace("$", r"\$")


def has_place(value: Any) -> bool:
    """Whether a value has a place on an axis of numbers: null, lists and texts have none."""
    return is_number(value) and math.isfinite(value)


def numeric_names(trials: Sequence[TrialRecord]) -> list[str]:
    """Return the searched hyperparameters that can be an axis: numbers with at least two values, lr first.

    One that doesn't act in some trials is none, nor one that is null or a list in some, as these would have no place on
    it. Trials whose points are not chosen yet don't count.
    """
    points = [point for trial in trials if (point := shown_point(trial))]
    names = []
    for name in point_names(trials):
        values = [point.get(name) for point in points]
        if all(map(has_place, values)) and len(set(values)) > 1:
            names.append(name)
    return sorted(names, key=lambda name: name != "lr")


def group_names(trials: Sequence[TrialRecord], axis: str | None) -> list[str]:
    """Return up to two searched hyperparameters that group trials: they have few values and are not the axis."""
    names, points = [], [shown_point(trial) for trial in trials]
    for name in point_names(trials):
        values = {cell_value(point.get(name)) for point in points}
        if name != axis and 1 < len(values) <= _MAX_GROUP_VALUES:
            names.append(name)
    return names[:2]


def _value(point: Mapping[str, Any], name: str) -> Any:
    return EMPTY if lacks(point, name) else cell_value(point.get(name))


def group_styles(trials: Sequence[TrialRecord], names: Sequence[str]) -> dict[str, Style]:
    """Return a style for each trial id: colour by combination of values, marker by the first, line by the last.

    Without names all trials share one style with an empty label. In a population the values are those that the score
    was reached with.
    """
    if not names:
        return {trial.trial_id: Style("", PALETTE[0], MARKERS[0], LINES[0]) for trial in trials}
    points = {trial.trial_id: shown_point(trial) for trial in trials}
    keys = {trial_id: tuple(_value(point, name) for name in names) for trial_id, point in points.items()}
    first = list(dict.fromkeys(key[0] for key in keys.values()))
    last = list(dict.fromkeys(key[-1] for key in keys.values()))
    styles = {
        key: Style(
            label=" · ".join(str(value) for value in key if value != EMPTY) or f"no {' and no '.join(names)}",
            color=PALETTE[number % len(PALETTE)],
            marker=MARKERS[first.index(key[0]) % len(MARKERS)],
            line=LINES[last.index(key[-1]) % len(LINES)],
        )
        for number, key in enumerate(dict.fromkeys(keys.values()))
    }
    return {trial_id: styles[key] for trial_id, key in keys.items()}


@contextlib.contextmanager
def own_style(*, fonts: bool = True) -> Iterator[None]:
    """Make and save the figures of the block as they are meant, whatever style the caller has set for others.

    Args:
        fonts: Whether this is so of fonts, too, and of TeX, which may not be there; of a paper's they are the caller's.
    """
    import matplotlib as mpl

    left = _OF_THE_PROCESS if fonts else _OF_THE_PROCESS + _FONTS
    with _styled:
        # As dicts: to ask for the backend loads it. Not by `matplotlib.style`, which reads all styles as it is loaded.
        changes = {
            name: value
            for name, value in dict.items(mpl.rcParamsDefault)
            if dict.get(mpl.rcParams, name) != value and not name.startswith(left)
        }
        with mpl.rc_context(changes):
            yield


def new_figure(size: tuple[float, float]) -> Figure:
    """Return an empty figure with automatic layout; the size is in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained", facecolor="white")


def style_axes(axes: Axes, *, xlabel: str, ylabel: str, title: str = "") -> None:
    """Give axes labels and a light grid, and no box around the data."""
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
    """Make the horizontal axis one of env steps from 0, with short numbers: 12k, 1.5M."""
    from matplotlib.ticker import EngFormatter, MaxNLocator

    axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def drawable(values: ArrayLike) -> NDArray[np.float64]:
    """Return finite values, limited so that matplotlib's axes don't overflow near the largest floats."""
    return np.clip(np.asarray(values, dtype=np.float64), -MAX_DRAWN, MAX_DRAWN)


def goal_line(axes: Axes, threshold: float | None, *, axis: Literal["x", "y"] = "y") -> None:
    """Draw the return to reach as a dashed line, if there is one.

    Args:
        axes: Where it is drawn.
        threshold: The return; None: there is none.
        axis: The axis that returns are on.
    """
    if threshold is not None:
        draw = axes.axhline if axis == "y" else axes.axvline
        draw(
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
    """Put the legend beside a wide figure, or below a narrow one or where asked; never over the data."""
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


def _fit(figure: Figure) -> None:
    """Lay the figure out as SVG would have it, for every format that it is saved in from then on.

    To lay it out takes as long as to draw it. And while a figure has an engine for its layout, even one that does
    nothing, matplotlib draws it one more time, in vain, whenever it is saved.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    engine = figure.get_layout_engine()
    if engine is None:
        return
    FigureCanvasSVG(figure)  # becomes the figure's canvas, by which texts are measured
    figure.set_dpi(_DPI_OF_SVG)
    engine.execute(figure)
    with mpl.rc_context({"figure.autolayout": False, "figure.constrained_layout.use": False}):
        figure.set_layout_engine(None)


def to_png(figure: Figure, *, dpi: int = 160) -> bytes:
    """Return the figure as PNG on white."""
    _fit(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def to_pdf(figure: Figure) -> bytes:
    """Return the figure as PDF; the same figure gives the same bytes.

    Its letters are Type 3 fonts, which take a tenth of the time; some journals want others (`analysis.exports.paper`).
    """
    _fit(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="pdf", metadata={"CreationDate": None})
    return buffer.getvalue()


def to_svg_file(figure: Figure) -> str:
    """Return the figure as a whole SVG file, transparent; the same figure gives the same text.

    Letters become shapes, which look the same whatever fonts the reader has.
    """
    import matplotlib as mpl

    _fit(figure)
    buffer = io.StringIO()
    # The salt makes the ids reproducible.
    with mpl.rc_context({"svg.fonttype": "path", "svg.hashsalt": "figure"}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    return buffer.getvalue()


def to_svg(figure: Figure, *, label: str, prefix: str) -> str:
    """Return the figure as an `<svg>` element for a page, see `page_svg`."""
    return page_svg(to_svg_file(figure), label=label, prefix=prefix)


def page_svg(svg: str, *, label: str, prefix: str) -> str:
    """Return a figure's SVG file as an `<svg>` element for a page, with colours that the page may override.

    Every colour of this module becomes `var(--name, #rrggbb)`: the page's theme sets the variables
    (`CSS_LIGHT`, `CSS_DARK`) and the picture is right without them.

    Args:
        svg: What `to_svg_file` returned.
        label: The text for screen readers.
        prefix: Put before every id, or two figures in one page would take each other's clip paths.
    """
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    # Comments contain label texts, which come from sweep files and errors and must not reach the page unescaped.
    svg = re.sub(r"<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\1{prefix}-", svg)
    for color, name in _CSS_NAMES.items():
        svg = svg.replace(f": {color}", f": var(--{name}, {color})")
    return svg.replace("<svg ", f'<svg role="img" aria-label="{html.escape(label)}" ', 1)

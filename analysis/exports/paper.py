"""A figure for a paper: how the leading settings of one sweep or several learn, with bands over training seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from analysis.exports.frames import SweepData, ranked_settings
from analysis.objectives import SettingScores
from analysis.plot_style import (
    ACCENT,
    GRID,
    MARKERS,
    PALETTE,
    drawable,
    escape,
    new_figure,
    own_style,
    steps_axis,
    style_axes,
)
from analysis.points import searched_names
from analysis.statistics import seed_intervals
from analysis.tables import cell_value
from analysis.wording import counted, setting_text, short_text
from policies.errors import CannotRunError, NotFoundError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Returns = Literal["evaluation", "training"]
"""Which returns a curve is of: greedy evaluations, or the mean of the last 100 training episodes."""
COLUMN_WIDTH = (3.4, 2.5)
"""The size of a figure in one column of a paper with two, inches."""
FORMATS = ("pdf", "svg", "png")
_NUM_POINTS = 120
_NUM_MARKERS = 8
"""About how many markers a curve has that needs them to be told from another of its colour."""
_FONT_SIZE = 8.0
_AXES: dict[Returns, str] = {
    "evaluation": "evaluation return",
    "training": "training return, mean of 100 episodes",
}


@dataclass(frozen=True)
class Curve:
    """The learning curve of a setting over its training seeds."""

    label: str
    num_seeds: int
    """Those that it is of."""
    num_without: int
    """Seeds that showed no such return, as those that failed before their first evaluation; it is not of them."""
    num_env_steps: NDArray[np.float64]
    """Shape (T,)."""
    mean: NDArray[np.float64]
    """Over the seeds, shape (T,)."""
    lower: NDArray[np.float64] | None
    """The lower end of the pointwise 95 % interval over training seeds, shape (T,); None: one seed a setting."""
    upper: NDArray[np.float64] | None
    least: float
    """The lowest return of any of the seeds."""
    most: float
    """The highest."""
    first_end: float
    """Env steps at which the first of the seeds had ended; from there on it is held at its last value."""


def setting_curves(data: SweepData, *, top: int, returns: Returns = "evaluation") -> list[Curve]:
    """Return the learning curves of the leading settings of a sweep, best first.

    Returns are interpolated between those that are known, and a curve begins where all of its seeds have shown one. A
    seed that ended before others of the figure, because it reached its goal or failed, is held at its last value: to
    leave it out would make the mean that of the others. One that showed no such return has no value to be held at; the
    curve is that of the others, and counts those it lacks. The intervals are `statistics.seed_intervals` over all
    settings whose curves have begun, at each number of env steps by itself.

    Args:
        data: The sweep.
        top: How many settings.
        returns: Which returns.
    """
    return curves_of(data, ranked_settings(data)[:top], returns=returns)


def curves_of(data: SweepData, settings: Sequence[SettingScores], *, returns: Returns = "evaluation") -> list[Curve]:
    """Return the learning curves of settings of one sweep; those without any such return are left out."""
    known = []
    for item in settings:
        seeds = [curve for trial_id in item.trial_ids if (curve := _known(data, trial_id, returns))[0].size]
        if seeds:
            known.append((item, seeds))
    if not known:
        return []
    # Each begins by itself: one that is first evaluated late must not hide how the others began.
    starts = [max(steps[0] for steps, _ in seeds) for _, seeds in known]
    stop = max(steps[-1] for _, seeds in known for steps, _ in seeds)
    grid = np.unique(np.concatenate([np.linspace(min(starts), stop, _NUM_POINTS), starts]))
    places = [grid[grid >= start] for start in starts]
    values = [
        np.stack([np.interp(own, *seed) for seed in seeds]) for own, (_, seeds) in zip(places, known, strict=True)
    ]
    labels = _labels([item for item, _ in known])
    bands = _bands(values)
    return [
        Curve(
            label=label,
            num_seeds=len(seeds),
            num_without=len(item.trial_ids) - len(seeds),
            num_env_steps=steps,
            mean=own.mean(axis=0),
            lower=None if band is None else band[0],
            upper=None if band is None else band[1],
            least=float(own.min()),
            most=float(own.max()),
            first_end=min(seed[-1] for seed, _ in seeds),
        )
        for label, (item, seeds), steps, own, band in zip(labels, known, places, values, bands, strict=True)
    ]


@own_style(fonts=False)
def learning_figure(
    sweeps: Sequence[tuple[str, SweepData]],
    *,
    top: int = 3,
    returns: Returns = "evaluation",
    size: tuple[float, float] = COLUMN_WIDTH,
) -> Figure:
    """Draw the learning curves of the leading settings of one sweep or several, with bands over training seeds.

    A curve is the mean over the seeds of a setting, its band the 95 % interval of that mean; with one seed a setting
    there is no band. Curves are dashed from where the first of their seeds has ended. The legend says of how many seeds
    a curve is, and of how many it should be. Where there are more curves than colours, the later ones have markers.

    Args:
        sweeps: Name and data of each sweep; the name is part of labels if there are several.
        top: How many settings of each.
        returns: Which returns.
        size: Width and height, inches.

    Raises:
        NotFoundError: No sweep has a setting with such returns.
    """
    curves = [(name, curve) for name, data in sweeps for curve in setting_curves(data, top=top, returns=returns)]
    if not curves:
        raise NotFoundError(
            f"There is nothing to draw: no setting of {', '.join(name for name, _ in sweeps)} has "
            f"{returns} returns of a trial that has ended.",
            "Wait for the first trials to end; a population has no settings.",
        )
    figure = new_figure(size)
    axes = figure.subplots()
    for number, (name, curve) in enumerate(curves):
        label = curve.label if len(sweeps) == 1 else f"{name}: {curve.label}" if top > 1 and curve.label else name
        _draw_curve(axes, curve, label, number)
    style_axes(axes, xlabel="env steps", ylabel=_AXES[returns])
    axes.grid(visible=True, color=GRID, linewidth=0.5)
    steps_axis(axes)
    goals = {data.threshold for _, data in sweeps}
    goal = goals.pop() if len(goals) == 1 else None
    if goal is not None:
        height = float(drawable([goal])[0])
        axes.axhline(height, color=ACCENT, linewidth=0.9, linestyle=(0, (5, 3)), zorder=1.5, label=f"goal {goal:g}")
    # A band of few seeds goes beyond any return there can be, so it must not set the scale.
    _fit_returns(axes, [curve for _, curve in curves], goal)
    for text in (axes.xaxis.label, axes.yaxis.label, *axes.get_xticklabels(), *axes.get_yticklabels()):
        text.set_fontsize(_FONT_SIZE)
    handles, told = axes.get_legend_handles_labels()
    figure.legend(handles, told, loc="outside upper left", frameon=False, fontsize=_FONT_SIZE - 1, ncols=1)
    return figure


def _draw_curve(axes: Axes, curve: Curve, label: str, number: int) -> None:
    """Draw a curve with its band and, in the legend, its number of seeds; its number is its place among all curves."""
    turn, place = divmod(number, len(PALETTE))
    color = PALETTE[place]
    steps, mean = curve.num_env_steps, drawable(curve.mean)
    whole = steps <= curve.first_end
    seeds = counted(curve.num_seeds + curve.num_without, "seed")
    seeds = f"{curve.num_seeds:,} of {seeds}" if curve.num_without else seeds
    told = f"{label} ({seeds})" if label else seeds
    # A line of one place can't be seen, and from the second turn on a colour alone tells no curve.
    marker = MARKERS[turn % len(MARKERS)] if turn or steps.size == 1 else ""
    look: dict[str, Any] = {"color": color, "marker": marker, "markersize": 3}
    look["markevery"] = max(1, steps.size // _NUM_MARKERS)
    axes.plot(steps[whole], mean[whole], linewidth=1.2, label=escape(told), **look)
    after = np.flatnonzero(~whole)
    if after.size:
        # The dashes begin where the line ends, so that there is no gap.
        rest = slice(max(0, int(after[0]) - 1), None)
        axes.plot(steps[rest], mean[rest], linewidth=1.0, linestyle=(0, (3, 2)), **look)
    if curve.lower is not None and curve.upper is not None:
        low, high = drawable(curve.lower), drawable(curve.upper)
        axes.fill_between(steps, low, high, color=color, alpha=0.2, linewidth=0)


def _fit_returns(axes: Axes, curves: Sequence[Curve], goal: float | None) -> None:
    """Make the vertical axis one of the returns that seeds have, and of the goal."""
    ends = [end for curve in curves for end in (curve.least, curve.most)] + ([] if goal is None else [goal])
    low, high = (float(end) for end in drawable([min(ends), max(ends)]))
    margin = 0.05 * (high - low) or 1.0
    axes.set_ylim(low - margin, high + margin)


@own_style(fonts=False)
def save_figure(figure: Figure, path: Path) -> Path:
    """Write a figure as PDF, SVG or PNG, by the suffix of the path.

    Letters stay letters in PDF and SVG (Type 42 fonts, which journals ask for); a PNG has 300 dots an inch. The same
    figure gives the same file.

    Raises:
        CannotRunError: It cannot be written.
    """
    import matplotlib as mpl

    kind = path.suffix.lower().removeprefix(".")
    dates = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with mpl.rc_context({"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": path.stem}):
            figure.savefig(path, format=kind, dpi=300, metadata=dates.get(kind))
    except OSError as error:
        raise CannotRunError(
            f"{path} cannot be written: {error.strerror or error}.", "Give another path, or free space on its disk."
        ) from error
    return path


def _known(data: SweepData, trial_id: str, returns: Returns) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return env steps and returns of one trial, where it has any."""
    pairs = [
        (item.num_env_steps, value)
        for item in data.results.get(trial_id, ())
        if (value := item.evaluation_return if returns == "evaluation" else item.training_return) is not None
    ]
    array = np.asarray(pairs, dtype=np.float64).reshape(-1, 2)
    return array[:, 0], array[:, 1]


def _bands(
    values: Sequence[NDArray[np.float64]],
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]] | None]:
    """Return the ends of the intervals of each setting, or None of those without one.

    Args:
        values: The returns of the seeds of each setting, shape (seeds, T). All end at the same place, so that those of
            a setting with fewer places are at the last ones.
    """
    # Until a setting with two seeds has begun, nothing is known of how seeds differ.
    num_places = max((own.shape[1] for own in values if len(own) > 1), default=0)
    ends = np.full((len(values), 2, num_places), np.nan)
    try:
        for place in range(-num_places, 0):
            begun = [index for index, own in enumerate(values) if own.shape[1] >= -place]
            intervals = seed_intervals([values[index][:, place] for index in begun])
            ends[begun, :, place] = [(interval.lower, interval.upper) for interval in intervals]
    except ValueError:  # so large that their squares are not finite
        return [None] * len(values)
    return [
        (ends[index, 0, -own.shape[1] :], ends[index, 1, -own.shape[1] :]) if len(own) > 1 else None
        for index, own in enumerate(values)
    ]


def _labels(settings: Sequence[SettingScores]) -> list[str]:
    """Return what tells settings apart: the values that are not the same in all of them, or all values of a single.

    In as few digits as that takes; where four don't, and of equal settings, with their places before them.
    """
    names = searched_names(item.point for item in settings)
    differing = [name for name in names if len({repr(cell_value(item.point.get(name))) for item in settings}) > 1]
    shown = differing or names
    labels: list[str] = []
    for text in (short_text, setting_text):
        labels = [
            ", ".join(f"{name} {text(item.point[name])}" for name in shown if name in item.point) for item in settings
        ]
        if len(set(labels)) == len(labels):
            return labels
    return [f"{place}. {label}".rstrip() for place, label in enumerate(labels, start=1)]

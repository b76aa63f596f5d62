"""The figure of how sure a ranking is: the leading settings, with a dot for each training seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.plot_style import (
    INK,
    MUTED,
    PALETTE,
    add_legend,
    drawable,
    escape,
    goal_line,
    new_figure,
    steps_axis,
    style_axes,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_GOLDEN = 0.6180339887
_WIDTH_OF_DOTS = 0.5
"""How far the dots of one setting are spread, as a share of the distance to the next."""


@dataclass(frozen=True)
class Strip:
    """One setting."""

    label: str
    scores: tuple[float, ...]
    """One a training seed."""
    mean: float
    interval: tuple[float, float] | None
    """Over training seeds; None: there is none."""
    leads: bool
    """Whether it may be the best."""


def seed_strips(
    strips: Sequence[Strip],
    *,
    xlabel: str,
    threshold: float | None = None,
    counts_env_steps: bool = False,
    size: tuple[float, float],
) -> Figure:
    """Plot settings from top to bottom, each with its seeds as dots, its mean and its interval.

    Args:
        strips: The settings, best first.
        xlabel: What the scores are.
        threshold: Score to draw as the goal; None: none.
        counts_env_steps: Whether scores are env steps.
        size: Width and height, inches.

    Raises:
        ValueError: There is no setting.
    """
    if not strips:
        raise ValueError("there is no setting to draw")
    figure = new_figure(size)
    axes = figure.subplots()
    for row, strip in enumerate(strips):
        _draw(axes, row, strip)
    axes.set_yticks(range(len(strips)), [escape(strip.label) for strip in strips])
    axes.set_ylim(len(strips) - 0.4, -0.6)
    style_axes(axes, xlabel=escape(xlabel), ylabel="")
    axes.grid(visible=False, axis="y")
    if counts_env_steps:
        steps_axis(axes)
    goal_line(axes, threshold, axis="x")
    _add_keys(axes, strips)
    add_legend(figure, axes, [], size, below=True)
    return figure


def _draw(axes: Axes, row: int, strip: Strip) -> None:
    color = PALETTE[0] if strip.leads else MUTED
    if strip.interval is not None:
        low, high = drawable(strip.interval)
        axes.plot([low, high], [row, row], color=color, linewidth=7, alpha=0.25, solid_capstyle="butt", zorder=1)
    # Equal scores would hide each other on one line. Multiples of the golden ratio lie apart without a pattern.
    shifts = ((np.arange(len(strip.scores)) * _GOLDEN + 0.5) % 1.0 - 0.5) * _WIDTH_OF_DOTS
    axes.scatter(drawable(sorted(strip.scores)), row + shifts, s=26, color=color, linewidths=0, alpha=0.85, zorder=3)
    if len(strip.scores) < 2:  # the mean of one is its dot
        return
    mean = float(drawable([strip.mean])[0])
    axes.plot([mean, mean], [row - 0.36, row + 0.36], color=INK, linewidth=2, zorder=4)


def _add_keys(axes: Axes, strips: Sequence[Strip]) -> None:
    """Name what is drawn, in an order of its own; nothing is drawn by it."""
    for leads, text in ((True, "may be the best"), (False, "worse than the best")):
        if any(strip.leads == leads for strip in strips) and (leads or len(strips) > 1):
            color = PALETTE[0] if leads else MUTED
            axes.scatter([], [], s=26, color=color, linewidths=0, label=f"a seed, {text}")
    if any(len(strip.scores) > 1 for strip in strips):
        axes.plot([], [], color=INK, linewidth=2, label="mean")
    if any(strip.interval is not None for strip in strips):
        axes.plot([], [], color=MUTED, linewidth=7, alpha=0.4, label="95 % interval")

"""The figures of a sweep: learning curves, score against a hyperparameter, score per episode.

Each function returns a matplotlib `Figure` (built without pyplot, so it works without a display and in
threads); `plot_style.to_png` and `to_svg` turn it into a file. Returns are undiscounted and in reward units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.plot_style import (
    ACCENT,
    INK,
    MUTED,
    PALETTE,
    Style,
    add_legend,
    drawable,
    escape,
    goal_line,
    group_names,
    group_styles,
    has_place,
    new_figure,
    numeric_names,
    steps_axis,
    style_axes,
)
from analysis.records import IterationRecord, TrialRecord
from analysis.selection import score_trial
from analysis.tables import shown_point

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDE = (9.0, 4.2)
_MAX_LINE_POINTS = 300
_MAX_VECTOR_POINTS = 30_000
_HISTOGRAM_EPISODES = 50
_MEAN_EPISODES = 100


def learning_curves(
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    *,
    threshold: float | None,
    winner: str | None = None,
    size: tuple[float, float] = _WIDE,
) -> Figure:
    """Plot the training return (mean of the last 100 episodes) of every trial over its env steps.

    The winner is drawn thick; its greedy evaluations are dots. A trial that failed ends in a cross. Where a
    point has several seeds, the band around the winner is the range of its point over the seeds.

    Args:
        trials: The trials of one sweep.
        results: Iterations by trial id, oldest first; a trial may have none.
        threshold: Return to draw as the goal; None: none.
        winner: Trial id of the selected trial.
        size: Width and height, inches.
    """
    figure = new_figure(size)
    axes = figure.subplots()
    names = group_names(trials, axis=None)
    styles = group_styles(trials, names)
    total = sum(len(items) for items in results.values())
    labelled: set[str] = set()
    for trial in sorted(trials, key=lambda item: item.trial_id == winner):
        steps, returns = _curve(results.get(trial.trial_id, ()))
        if steps.size == 0:
            continue
        style, wins = styles[trial.trial_id], trial.trial_id == winner
        axes.plot(
            steps,
            returns,
            color=style.color,
            linestyle="-" if wins else style.line,
            linewidth=3.0 if wins else 1.3,
            alpha=1.0 if wins else 0.65,
            label=escape(_curve_label(style.label, wins=wins, known=style.label in labelled)),
            rasterized=total > _MAX_VECTOR_POINTS,
            # A trial of one iteration is a line without length, so a dot marks its end.
            marker=style.marker if steps.size == 1 else "",
            zorder=4 if wins else 2,
        )
        labelled.add(style.label)
        if trial.status == "failed":
            label = "" if "failed" in labelled else "failed"
            axes.plot(steps[-1:], returns[-1:], "x", ms=8, color=MUTED, mew=2, zorder=5, label=label)
            labelled.add(label)
        if wins:
            _draw_winner(axes, trial, trials, results, style)
    style_axes(axes, xlabel="env steps", ylabel="training return, mean of last 100 episodes")
    steps_axis(axes)
    goal_line(axes, threshold)
    add_legend(figure, axes, names, size)
    return figure


def score_by_lr(
    trials: Sequence[TrialRecord],
    *,
    name: str | None = None,
    threshold: float | None = None,
    winner: str | None = None,
    size: tuple[float, float] = _WIDE,
) -> Figure:
    """Plot the score of each trial against its learning rate, coloured by the hyperparameters with few values.

    Trials that cannot win are grey crosses on the lower edge, because they are part of the result. Those whose value is
    no number, such as null, are left out.

    Args:
        trials: The trials of one sweep.
        name: Hyperparameter of the horizontal axis; None: lr if it was searched, else the first searched number,
            else the groups themselves, side by side.
        threshold: Return to draw as the goal; None: none.
        winner: Trial id of the selected trial; it gets a ring.
        size: Width and height, inches.
    """
    figure = new_figure(size)
    axes = figure.subplots()
    if name is None:
        name = next(iter(numeric_names(trials)), None)
    names = group_names(trials, axis=name)
    styles = group_styles(trials, names)
    positions = _positions(trials, name, styles)
    for label in dict.fromkeys(style.label for style in styles.values()):
        members = [trial for trial in trials if styles[trial.trial_id].label == label]
        placed = [trial for trial in members if trial.trial_id in positions]
        scored = [(positions[t.trial_id], s.score) for t in placed if (s := score_trial(t)) is not None]
        if scored:
            style = styles[members[0].trial_id]
            x, y = zip(*scored, strict=True)
            axes.scatter(
                x,
                drawable(y),
                s=70,
                color=style.color,
                marker=style.marker,
                label=escape(label),
                zorder=3,
                linewidths=0,
                alpha=0.9,
            )
    _mark_lost_and_winner(axes, trials, positions, winner)
    style_axes(axes, xlabel=escape(name or " · ".join(names)), ylabel="best evaluation return")
    _value_axis(axes, list(positions.values()), name, styles)
    goal_line(axes, threshold)
    add_legend(figure, axes, names if name is not None else [], size)
    return figure


def score_per_episode(
    returns: Sequence[float] | NDArray[np.float64],
    *,
    goal: float | None,
    title: str = "",
    size: tuple[float, float] = _WIDE,
) -> Figure:
    """Plot the score of each episode with goal and linear trend; beside it, the histogram of the last 50.

    Args:
        returns: Undiscounted return of each training episode, in order. Shape (num_episodes,).
        goal: Score that counts as solved; None: none.
        title: Text above the figure.
        size: Width and height, inches; taller than wide puts the histogram below.

    Raises:
        ValueError: There is no episode.
    """
    scores = drawable(returns)
    if scores.ndim != 1 or scores.size == 0:
        raise ValueError(f"expected the returns of at least one episode, got shape {scores.shape}")
    figure = new_figure(size)
    tall = size[1] > size[0]
    # The ratios are of heights or of widths, so that the longer side of the figure is divided.
    grid = figure.add_gridspec(2, 1, height_ratios=[3, 2]) if tall else figure.add_gridspec(1, 2, width_ratios=[2, 1])
    left, right = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    episodes = np.arange(1, scores.size + 1)
    left.plot(
        episodes,
        scores,
        ".",
        markersize=4 if scores.size < 500 else 2.5,
        color=PALETTE[4],
        alpha=0.6,
        label="score",
        rasterized=scores.size > _MAX_VECTOR_POINTS,
    )
    if scores.size >= 2 * _MEAN_EPISODES:
        means = np.convolve(scores, np.full(_MEAN_EPISODES, 1 / _MEAN_EPISODES), mode="valid")
        left.plot(episodes[_MEAN_EPISODES - 1 :], means, color=PALETTE[0], linewidth=2.2, label="mean of last 100")
    if scores.size > 1:
        slope, offset = np.polyfit(episodes, scores, 1)
        left.plot(
            episodes[[0, -1]],
            offset + slope * episodes[[0, -1]],
            "--",
            color=MUTED,
            linewidth=1.8,
            label="linear trend",
        )
    style_axes(left, xlabel="episode", ylabel="score (episode return)", title=escape(title))
    goal_line(left, goal)
    # The trend of a policy that scores the maximum goes beyond any possible score, so it must not set the scale.
    low, high = float(scores.min()), max(float(scores.max()), goal if goal is not None else -np.inf)
    left.set_ylim(min(0.0, low), high + 0.06 * (high - min(0.0, low) or 1.0))
    add_legend(figure, left, [], size, below=True)
    last = scores[-_HISTOGRAM_EPISODES:]
    # The bins cover the range of the whole training, so that fifty equal scores are one bar at their height.
    right.hist(last, bins=20, range=(min(0.0, low), high), color=PALETTE[4], rwidth=0.92)
    style_axes(right, xlabel="score", ylabel="episodes", title=f"last {last.size} episodes")
    if goal is not None:
        right.axvline(goal, color=ACCENT, linewidth=1.6, linestyle=(0, (6, 3)))
    return figure


def _curve(items: Sequence[IterationRecord]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return env steps and training returns of the iterations that have one, thinned to at most 300 points."""
    pairs = [(item.num_env_steps, item.training_return) for item in items if item.training_return is not None]
    if not pairs:
        return np.empty(0), np.empty(0)
    array = drawable(pairs)
    if len(array) > _MAX_LINE_POINTS:
        array = array[np.linspace(0, len(array) - 1, _MAX_LINE_POINTS).round().astype(int)]
    return array[:, 0], array[:, 1]


def _curve_label(group: str, *, wins: bool, known: bool) -> str:
    """Return the legend text of a curve: the winner always has one, each group only once."""
    if wins:
        return f"winner: {group}" if group else "winner"
    return "" if known else group


def _draw_winner(
    axes: Axes,
    winner: TrialRecord,
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    style: Style,
) -> None:
    """Draw the winner's greedy evaluations and, where its point has several seeds, their range."""
    items = results.get(winner.trial_id, ())
    evaluated = [(i.num_env_steps, i.evaluation_return) for i in items if i.evaluation_return is not None]
    if evaluated:
        x, y = zip(*evaluated, strict=True)
        axes.plot(
            x,
            drawable(y),
            linestyle="",
            marker="o",
            markersize=6,
            markerfacecolor="none",
            markeredgecolor=INK,
            markeredgewidth=1.3,
            label="winner: greedy evaluation",
            zorder=5,
        )
    curves = [_curve(results.get(t.trial_id, ())) for t in trials if t.point_index == winner.point_index]
    curves = [curve for curve in curves if curve[0].size > 1]
    if len(curves) > 1:
        # Only where every seed has values: after the shortest trial, the range would be that of fewer seeds.
        start, stop = max(c[0][0] for c in curves), min(c[0][-1] for c in curves)
        if stop > start:
            grid = np.linspace(start, stop, 100)
            values = np.stack([np.interp(grid, *curve) for curve in curves])
            axes.fill_between(
                grid,
                values.min(axis=0),
                values.max(axis=0),
                color=style.color,
                alpha=0.18,
                linewidth=0,
                label=f"winner: range of {len(curves)} seeds",
                zorder=1,
            )


def _positions(trials: Sequence[TrialRecord], name: str | None, styles: Mapping[str, Style]) -> dict[str, float]:
    """Return each trial's position on the horizontal axis: its value, or the number of its group.

    A trial whose value is no finite number has none. In a population it is the value that the score was reached with.
    """
    if name is not None:
        points = {trial.trial_id: shown_point(trial) for trial in trials}
        return {trial_id: float(point[name]) for trial_id, point in points.items() if has_place(point.get(name))}
    labels = list(dict.fromkeys(style.label for style in styles.values()))
    positions = {}
    for i, label in enumerate(labels):
        members = [trial.trial_id for trial in trials if styles[trial.trial_id].label == label]
        # Placed side by side within the group, or equal scores would hide each other.
        for trial_id, shift in zip(members, np.linspace(-0.2, 0.2, len(members) + 2)[1:-1], strict=True):
            positions[trial_id] = i + float(shift)
    return positions


def _mark_lost_and_winner(
    axes: Axes, trials: Sequence[TrialRecord], positions: Mapping[str, float], winner: str | None
) -> None:
    lost = [t.trial_id for t in trials if score_trial(t) is None and t.status not in {"pending", "running"}]
    x = [positions[trial_id] for trial_id in lost if trial_id in positions]
    if x:
        # x in data, y as a share of the axes' height.
        axes.scatter(
            x,
            [0.03] * len(x),
            transform=axes.get_xaxis_transform(),
            marker="x",
            s=55,
            color=MUTED,
            linewidths=2,
            label="no score (failed or not evaluated)",
            zorder=3,
            clip_on=False,
        )
    best = next((score_trial(t) for t in trials if t.trial_id == winner), None)
    if best is not None and winner is not None and winner in positions:
        axes.scatter(
            [positions[winner]],
            drawable([best.score]),
            s=260,
            facecolors="none",
            edgecolors=INK,
            linewidths=1.6,
            label="winner",
            zorder=4,
        )


def _value_axis(axes: Axes, values: Sequence[float], name: str | None, styles: Mapping[str, Style]) -> None:
    """Make the axis logarithmic if positive values span more than a decade, or show group names without numbers."""
    if name is None:
        labels = list(dict.fromkeys(style.label for style in styles.values()))
        axes.set_xticks(range(len(labels)), [escape(label) or "all trials" for label in labels])
        axes.set_xlim(-0.6, len(labels) - 0.4)
    elif values and min(values) > 0 and max(values) > 10 * min(values):
        from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

        axes.set_xscale("log")
        # Over less than two decades, powers of ten are too few labels, and matplotlib's ten per decade overlap.
        subs = (1.0, 2.0, 5.0) if max(values) < 100 * min(values) else (1.0,)
        axes.xaxis.set_major_locator(LogLocator(subs=subs))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))

"""Charts of how settings learn: curves over env steps, and the scores of their seeds as a profile."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.charts.model import Axis, Chart, Line, Number, Plot, Plots, drawable
from analysis.charts.subject import Subject
from analysis.first_seeds import first_seeds
from analysis.objectives import SettingScores
from analysis.plot_style import PALETTE
from analysis.statistics import performance_profile
from analysis.wording import counted

ENV_STEPS = "env steps"
NUM_TOP = 4
"""How many of the leading settings are shown by name."""
_MAX_PALE = 80
_NUM_PALE_POINTS = 40
_NUM_POINTS = 80
_Curve = tuple[NDArray[np.float64], NDArray[np.float64]]


def make_charts(subject: Subject) -> list[Chart]:
    """Return the charts of how it learns."""
    return [_curves_chart(subject), _profile_chart(subject)]


def curve(subject: Subject, trial_id: str, num_points: int) -> _Curve:
    """Return env steps and training returns of a trial, at most so many, its last one included."""
    pairs = [(item.num_env_steps, drawable(item.training_return)) for item in subject.results.get(trial_id, ())]
    known = np.array([pair for pair in pairs if pair[1] is not None], dtype=np.float64).reshape(-1, 2)
    if len(known) > num_points:
        known = known[np.linspace(0, len(known) - 1, num_points).round().astype(int)]
    return known[:, 0], known[:, 1]


def _curves_chart(subject: Subject) -> Chart:
    several = any(len(setting.scores) > 1 for setting in subject.settings)
    title = "How the leading settings learn"
    what = "Training return (mean of the last 100 episodes, exploring)"
    caption = f"{what} of the leading trials, one seed a setting; the others are pale."
    if subject.is_population:
        caption = f"{what} of the population; the leading trials in colour."
    elif several:
        caption = (
            f"{what}: median and range over the seeds of each leading setting, its seeds thin, the other trials pale."
        )
    top = subject.settings[:NUM_TOP]
    lines = [line for rank, setting in enumerate(top) for line in _setting_lines(subject, setting, rank)]
    in_top = {trial_id for setting in top for trial_id in setting.trial_ids}
    pale, notes = _pale_lines(subject, in_top)
    if not lines and not pale:
        why = "No training episode has ended, so there is nothing to draw." if subject.begun else "No trial has begun."
        return Chart("curves_of_settings", "learning", title, caption, None, why)
    plot = Plot(Axis(ENV_STEPS, low=0), Axis("training return"), (*pale, *lines), goal=drawable(subject.goal))
    return Chart("curves_of_settings", "learning", title, caption, Plots((plot,)), notes=notes)


def _setting_lines(subject: Subject, setting: SettingScores, rank: int) -> list[Line]:
    """Return the lines of a leading setting: its seeds, and median and range where all of them have values."""
    color, name = f"series-{rank % len(PALETTE)}", f"{rank + 1}. {subject.setting_name(setting)}"
    curves = [curve(subject, trial_id, _NUM_POINTS) for trial_id in setting.trial_ids]
    curves = [found for found in curves if found[0].size > 0]
    if len(curves) < 2:
        return [_line(name, color, *found) for found in curves]
    seeds = Line(name, color, *_joined(curves), look="thin")
    start, stop = max(found[0][0] for found in curves), min(found[0][-1] for found in curves)
    if stop <= start:
        return [seeds]
    grid = np.linspace(start, stop, _NUM_POINTS)
    values = np.stack([np.interp(grid, *found) for found in curves])
    median = _line(f"{name} ({counted(len(curves), 'seed')})", color, grid.round(), np.median(values, axis=0))
    band = Line(
        median.name, color, median.x, median.y, tuple(values.min(axis=0).tolist()), tuple(values.max(axis=0).tolist())
    )
    return [Line(median.name, color, seeds.x, seeds.y, look="thin"), band]


def _pale_lines(subject: Subject, in_top: set[str]) -> tuple[list[Line], tuple[str, ...]]:
    """Return the other trials: one line with gaps, and the ends of those that were cut early or did not end."""
    others = [trial for trial in subject.begun if trial.trial_id not in in_top]
    with_curve = [trial for trial in others if len(curve(subject, trial.trial_id, 1)[0])]
    picks = np.unique(np.linspace(0, len(with_curve) - 1, min(len(with_curve), _MAX_PALE)).round().astype(int))
    drawn = [with_curve[pick] for pick in picks]
    num_left_out = len(with_curve) - len(drawn)
    notes = (f"{len(drawn)} of the {len(with_curve):,} other trials are drawn.",) if num_left_out else ()
    curves = [curve(subject, trial.trial_id, _NUM_PALE_POINTS) for trial in drawn]
    lines = [Line("other trials", "muted", *_joined(curves), look="pale")] if curves else []
    short = [trial for trial in subject.begun if subject.ending(trial) in ("cut", "unfinished")]
    drawn_ids = {trial.trial_id for trial in drawn} | in_top
    ends = [curve(subject, trial.trial_id, _NUM_PALE_POINTS) for trial in short if trial.trial_id in drawn_ids]
    ends = [found for found in ends if found[0].size > 0]
    if ends:
        x, y = (tuple(found[axis][-1].item() for found in ends) for axis in (0, 1))
        lines.append(Line("cut early, or not ended yet", "muted", x, y, look="hollow"))
    return lines, notes


def _profile_chart(subject: Subject) -> Chart:
    title = "Performance profile"
    caption = (
        "The share of training seeds that scored more than each value, higher is better; the bands of all and of the "
        "first are pointwise 95 % intervals."
    )
    whole = {trial.trial_id for trial in subject.trials if subject.ending(trial) in ("whole", "failed")}
    settings = [setting for setting in subject.settings if whole.issuperset(setting.trial_ids)]
    scores = _drawn(setting.scores for setting in settings)
    first = _drawn(first_seeds(settings, subject.sweep))
    if len(first) < 2 or min(scores) == max(scores):
        why = (
            f"All {len(scores)} whole trials scored the same, so the profile would be one step."
            if len(first) > 1
            else "A profile takes the scores of at least two trials that trained to their end."
        )
        return Chart("performance_profile", "learning", title, caption, None, why)
    margin = 0.03 * (max(scores) - min(scores))
    thresholds = np.linspace(min(scores) - margin, max(scores) + margin, _NUM_POINTS)
    lines = [_profile_line("all settings", "muted", first, thresholds)]
    for rank, setting in enumerate(subject.settings[:NUM_TOP]):
        if setting in settings and len(setting.scores) > 1:
            name = f"{rank + 1}. {subject.setting_name(setting)} ({counted(len(setting.scores), 'seed')})"
            # The bands of several would hide each other.
            line = _profile_line(name, f"series-{rank % len(PALETTE)}", setting.scores, thresholds)
            lines.append(line if rank == 0 else dataclasses.replace(line, lower=(), upper=()))
    notes = ["A trial that failed counts as the worst score."] if any(item.num_failed for item in settings) else []
    if len(first) < len(scores):
        notes.append(
            "All settings: as many seeds of each as every one has, the first ones. A race or a replication gave the "
            "leading ones more, by which they would count more often."
        )
    if subject.num_not_whole:
        notes.append("Settings with trials that did not train to the end are left out.")
    if len(lines) == 1 and not subject.is_population:
        notes.append("One seed a setting gives no profile of a single setting: replicate the leading ones.")
    plot = Plot(Axis(subject.score_name), Axis("share of seeds", low=0, high=1), tuple(lines))
    return Chart("performance_profile", "learning", title, caption, Plots((plot,)), notes=tuple(notes))


def _drawn(settings: Iterable[Sequence[float]]) -> list[float]:
    """Return the scores of all settings that axes can be drawn to as they are."""
    return [score for scores in settings for score in scores if drawable(score) == score]


def _profile_line(name: str, color: str, scores: Sequence[float], thresholds: NDArray[np.float64]) -> Line:
    profile = performance_profile([np.array(scores)], thresholds)
    x, y, lower, upper = (
        tuple(array.tolist()) for array in (profile.thresholds, profile.shares, profile.lower, profile.upper)
    )
    return Line(name, color, x, y, lower, upper, is_stepped=True)


def _line(name: str, color: str, x: NDArray[np.float64], y: NDArray[np.float64]) -> Line:
    return Line(name, color, tuple(x.tolist()), tuple(y.tolist()))


def _joined(curves: Sequence[_Curve]) -> tuple[tuple[Number, ...], tuple[Number, ...]]:
    """Return curves as one, with gaps between them."""
    x: list[Number] = []
    y: list[Number] = []
    for steps, returns in curves:
        x += [*steps.tolist(), None]
        y += [*returns.tolist(), None]
    return tuple(x[:-1]), tuple(y[:-1])

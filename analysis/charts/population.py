"""Chart of population based training: which values each trial had, over its env steps."""

from __future__ import annotations

from collections.abc import Sequence

from analysis.charts.columns import column
from analysis.charts.learning import ENV_STEPS
from analysis.charts.model import Axis, Chart, Line, Number, Plot, Plots
from analysis.charts.subject import Subject
from analysis.plot_style import PALETTE
from analysis.points import value_of, value_text
from analysis.records import TrialRecord
from analysis.tables import point_names, points_of

_MAX_PALE = 80
_NUM_TOP = 3


def make_charts(subject: Subject) -> list[Chart]:
    """Return the chart of the schedules; none for a sweep whose trials keep their values."""
    if not subject.is_population:
        return []
    title = "The population's schedules"
    caption = "The value that each trial had over its env steps; it jumps where it went on from a better one's copy."
    changing = _names(subject)
    if not changing:
        why = "No trial has gone on from another's copy yet, so every value is as it was at the start."
        if any(trial.changes for trial in subject.trials):
            why = "All trials have had the same values, and no copy has changed one."
        return [Chart("schedules", "learning", title, caption, None, why)]
    top = [trial_id for setting in subject.settings[:_NUM_TOP] for trial_id in setting.trial_ids]
    others = [trial for trial in subject.begun if trial.trial_id not in top]
    notes = (f"{_MAX_PALE} of the {len(others):,} other trials are drawn.",) if len(others) > _MAX_PALE else ()
    drawn = [trial for trial in subject.begun if trial.trial_id in top] + others[:_MAX_PALE]
    plots = tuple(_plot(subject, name, drawn, top) for name in changing)
    return [Chart("schedules", "learning", title, caption, Plots(plots), notes=notes)]


def _names(subject: Subject) -> list[str]:
    """Return the names of which trials have had several values, the most important first; none before any copy.

    Those that all trials end with alike were searched, too.
    """
    if not any(trial.changes for trial in subject.trials):
        return []
    points = [point for trial in subject.begun for point in points_of(trial)]
    names = dict.fromkeys([*subject.varied_names, *point_names(subject.begun)])
    return [name for name in names if len({value_text(point, name) for point in points}) > 1]


def _plot(subject: Subject, name: str, trials: Sequence[TrialRecord], top: Sequence[str]) -> Plot:
    steps = [schedule(trial, name) for trial in trials]
    # The column of all values together gives them one scale, and one place to each category.
    flat = column(name, [value for _, values in steps for value in values], subject.space)
    places = iter(flat.values)
    pale_x: list[Number] = []
    pale_y: list[Number] = []
    lines = []
    for trial, (at, values) in zip(trials, steps, strict=True):
        found = [next(places) for _ in values]
        if trial.trial_id in top:
            color = f"series-{top.index(trial.trial_id) % len(PALETTE)}"
            lines.append(Line(trial.trial_id, color, tuple(at), tuple(found), is_stepped=True))
        else:
            pale_x += [*at, None]
            pale_y += [*found, None]
    if pale_x:
        lines.insert(0, Line("other trials", "muted", tuple(pale_x), tuple(pale_y), look="pale", is_stepped=True))
    return Plot(Axis(ENV_STEPS, low=0), flat.axis, tuple(lines))


def schedule(trial: TrialRecord, name: str) -> tuple[list[int], list[object]]:
    """Return the env steps at which a trial began to have each value of a hyperparameter, and those values.

    Where it did not act, the value is `IDLE`. The last value is given again at the trial's end.
    """
    steps: list[int] = [0, *(change.num_env_steps for change in trial.changes)]
    values = [*(value_of(change.before, name) for change in trial.changes), value_of(trial.point, name)]
    end = max(trial.num_env_steps, steps[-1])
    return [*steps, end], [*values, values[-1]]

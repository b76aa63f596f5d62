"""Charts of what a sweep cost: the best so far against env steps spent, and when each trial ran on which node."""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence

import numpy as np

from analysis.best_so_far import best_so_far, has_evaluations, is_moment
from analysis.charts.model import Axis, Bar, Chart, Line, Number, Plot, Plots, Timeline, drawable
from analysis.charts.subject import Subject
from analysis.records import TrialRecord
from analysis.wording import counted, duration, return_text

_MAX_BARS = 2_000
_LEAST_PAUSE = 0.1
"""Of the time in which trials ran."""
_COLORS = {"completed": "series-2", "stopped": "series-1", "failed": "accent", "running": "series-4"}


def make_charts(subject: Subject) -> list[Chart]:
    """Return the charts of what it cost."""
    return [_best_so_far(subject), _timeline(subject)]


def _best_so_far(subject: Subject) -> Chart:
    evaluated = has_evaluations(subject.results)
    what = "evaluation return" if evaluated else "training return"
    title = "Best so far against what was spent"
    caption = f"The best {what} that any trial had shown, over the env steps that all trials had trained for by then."
    found = best_so_far(subject.begun, subject.results, evaluated=evaluated)
    if not found.improvements:
        why = "No trial has shown a return yet." if subject.begun else "No trial has begun."
        return Chart("best_so_far", "cost", title, caption, None, why)
    rising = found.improvements
    x: tuple[Number, ...] = (*(item.spent for item in rising), found.spent)
    y: tuple[Number, ...] = tuple(drawable(item.value) for item in (*rising, rising[-1]))
    texts = (
        *(f"{item.trial_id}, at {item.num_env_steps:,} of its own env steps" for item in rising),
        "all that was spent",
    )
    untimed = ("The records lack when trials began, so they are taken one after the other by their number.",)
    line = Line(f"best {what} so far", "series-0", x, y, is_stepped=True, texts=texts)
    axes = Axis("env steps spent by all trials", low=0), Axis(f"best {what}")
    plot = Plot(*axes, (line,), goal=drawable(subject.goal))
    return Chart("best_so_far", "cost", title, caption, Plots((plot,)), notes=() if found.is_timed else untimed)


def _timeline(subject: Subject) -> Chart:
    title = "When each trial ran, and where"
    caption = (
        "Each bar is a trial, from its first start to its last end; each row is one of the places that a node's trials "
        "had side by side."
    )
    known = [trial for trial in subject.begun if is_moment(trial.started_at) and _end(trial) is not None]
    if not known:
        why = "The records hold no times of trials." if subject.begun else "No trial has begun."
        return Chart("timeline", "cost", title, caption, None, why)
    notes = ["Records hold a trial's node and process, not its core; the members of a pack share a process."]
    if len(known) < len(subject.begun):
        notes.append(f"{counted(len(subject.begun) - len(known), 'trial')} without times left out.")
    picks = list(range(len(known)))
    if len(known) > _MAX_BARS:
        notes.append(f"{_MAX_BARS:,} of {len(known):,} trials are drawn, spread evenly.")
        picks = np.linspace(0, len(known) - 1, _MAX_BARS).round().astype(int).tolist()
    pauses = _pauses([(_start(trial), _end(trial) or _start(trial)) for trial in known])
    if pauses:
        lasted = duration(sum(end - start for start, end in pauses))
        notes.append(f"{counted(len(pauses), 'pause')} in which no trial ran left out: {lasted}.")
    first = min(_start(trial) for trial in known)

    def since(time: float) -> float:
        """Return the seconds since the first trial began, without the pauses until then."""
        return time - first - sum(end - start for start, end in pauses if end <= time)

    unit, seconds = _unit(max(since(_end(trial) or first) for trial in known))
    rows, labels = _rows(known)
    bars = tuple(
        Bar(
            row,
            since(_start(trial)) / seconds,
            since(_end(trial) or first) / seconds,
            trial.status,
            _COLORS.get(trial.status, "muted"),
            _bar_text(trial),
        )
        for trial, row in ((known[pick], rows[pick]) for pick in picks)
    )
    axes = Axis(f"{unit} since the first trial began", low=0), Axis("node, and place on it", "category", tuple(labels))
    return Chart("timeline", "cost", title, caption, Timeline(*axes, bars), notes=tuple(notes))


def _pauses(times: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the times between which no trial ran, if they are long beside those in which some did."""
    pauses = []
    busy, until = 0.0, -math.inf
    for start, end in sorted(times):
        if start > until and math.isfinite(until):
            pauses.append((until, start))
        busy += max(0.0, end - max(start, until))
        until = max(until, end)
    return [(start, end) for start, end in pauses if end - start > _LEAST_PAUSE * busy]


def _rows(trials: Sequence[TrialRecord]) -> tuple[list[int], list[str]]:
    """Return the row of each trial, and the label of each row: as few rows a node as its trials can share."""
    rows: dict[str, int] = {}
    labels: list[str] = []
    for node in sorted({_node(trial) for trial in trials}):
        members = [trial for trial in trials if _node(trial) == node]
        members.sort(key=lambda trial: (_start(trial), trial.pid or 0, trial.index))
        busy: list[tuple[float, int]] = []
        free: list[int] = []
        num_rows = 0
        for trial in members:
            while busy and busy[0][0] <= _start(trial):
                heapq.heappush(free, heapq.heappop(busy)[1])
            if free:
                place = heapq.heappop(free)
            else:
                place, num_rows = num_rows, num_rows + 1
            heapq.heappush(busy, (_end(trial) or _start(trial), place))
            rows[trial.trial_id] = len(labels) + place
        labels += [f"{node}, {place + 1}" for place in range(num_rows)]
    return [rows[trial.trial_id] for trial in trials], labels


def _bar_text(trial: TrialRecord) -> str:
    process = "" if trial.pid is None else f", process {trial.pid}"
    took = duration((_end(trial) or _start(trial)) - _start(trial))
    best = trial.best_evaluation_return
    score = "" if best is None else f"; best evaluation {return_text(best)}"
    return f"{trial.trial_id}, {trial.status}, {took}{process}{score}"


def _node(trial: TrialRecord) -> str:
    """Return the node that a trial ran on; Ray's id behind the address says nothing to a reader."""
    return (trial.node or "node not known").partition("/")[0]


def _start(trial: TrialRecord) -> float:
    return trial.started_at or 0.0


def _end(trial: TrialRecord) -> float | None:
    """Return when a trial ended; one that runs has lasted as long as it has trained. None: not known."""
    ended = trial.ended_at if is_moment(trial.ended_at) else _start(trial) + trial.time_s
    return ended if ended is not None and is_moment(ended) and ended >= _start(trial) else None


def _unit(seconds: float) -> tuple[str, float]:
    if seconds < 300.0:
        return "seconds", 1.0
    return ("minutes", 60.0) if seconds < 3 * 3600.0 else ("hours", 3600.0)

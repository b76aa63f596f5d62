"""The best return that any trial of a sweep had shown, against the env steps that all had trained for by then."""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from analysis.records import IterationRecord, TrialRecord, finite_or_none

_LAST_MOMENT = 1e12
"""A time that is later is none: it was written by something else than a clock."""


@dataclass(frozen=True)
class Improvement:
    """A return that was better than all that had been shown before."""

    spent: int
    """Env steps that all trials had trained for by then."""
    value: float
    trial_id: str
    num_env_steps: int
    """Env steps that the trial itself had trained for."""


@dataclass(frozen=True)
class BestSoFar:
    """How the best return of a sweep rose."""

    improvements: tuple[Improvement, ...]
    """In the order in which they came; none: no trial has shown a return."""
    spent: int
    """Env steps that all trials have trained for."""
    is_timed: bool
    """Whether it is known when trials began; else they are taken one after the other by their number."""


def has_evaluations(results: Mapping[str, Sequence[IterationRecord]]) -> bool:
    """Return whether any trial was evaluated."""
    return any(item.evaluation_return is not None for items in results.values() for item in items)


def best_so_far(
    trials: Sequence[TrialRecord], results: Mapping[str, Sequence[IterationRecord]], *, evaluated: bool
) -> BestSoFar:
    """Return how the best return of a sweep rose.

    Args:
        trials: The trials that have begun.
        results: Iterations by trial id, oldest first; a trial may have none.
        evaluated: Whether it is of greedy evaluations; else of training returns.
    """
    trials = sorted(trials, key=lambda trial: trial.index)
    is_timed = all(is_moment(trial.started_at) for trial in trials)
    # A number each of all iterations, of which there may be millions: as objects they would take gigabytes.
    moments, values = array("d"), array("d")
    places, iterations, own, added = (array("q") for _ in range(4))
    for place, trial in enumerate(trials):
        began = trial.started_at - _earlier_s(trial) if is_timed and trial.started_at is not None else 0.0
        steps = 0
        for item in results.get(trial.trial_id, ()):
            moments.append(began + item.time_s if is_timed and math.isfinite(item.time_s) else began)
            places.append(place)
            iterations.append(item.iteration)
            own.append(item.num_env_steps)
            added.append(max(0, item.num_env_steps - steps))
            value = finite_or_none(item.evaluation_return if evaluated else item.training_return)
            values.append(-math.inf if value is None else value)
            steps = max(steps, item.num_env_steps)
    spent, best = 0, -math.inf
    found: list[Improvement] = []
    for index in np.lexsort([np.asarray(key) for key in (iterations, places, moments)]).tolist():
        spent += added[index]
        if values[index] > best:
            best = values[index]
            found.append(Improvement(spent, best, trials[places[index]].trial_id, own[index]))
    return BestSoFar(tuple(found), spent, is_timed)


def _earlier_s(trial: TrialRecord) -> float:
    """Return the seconds of the attempts before the one that `started_at` is of; times of iterations count them too."""
    if trial.started_at is None or not is_moment(trial.ended_at) or trial.ended_at is None:
        return 0.0
    earlier = trial.time_s - (trial.ended_at - trial.started_at)
    return earlier if 0.0 < earlier < _LAST_MOMENT else 0.0


def is_moment(time: float | None) -> bool:
    """Return whether a Unix time is known and can be one."""
    return time is not None and 0.0 <= time < _LAST_MOMENT

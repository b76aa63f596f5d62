"""What points had come to at the rungs that they passed, which says what the scores of those that ended there mean.

Where a scheduler ends the worse of two kinds of points, those of one kind have scores of whole trainings alone, those
of the other scores of the first rung alone: whether the kind is worse or the training short, these don't tell. What the
better ones had at that rung does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from analysis.records import TrialRecord, whole_length
from tune_jobs.spec.sweep_spec import SweepSpec

if TYPE_CHECKING:
    from tune_jobs.search.gains import Score

TAKE_RUNGS = ("gp",)
"""The search methods that are told of rungs."""
ReadCurves = Callable[[Sequence[str]], "Mapping[str, Sequence[Score]]"]
"""Returns the evaluations of trials, in their order."""


class Passed(NamedTuple):
    """A rung that a point's trainings went on from, each number the mean over its seeds."""

    trained: float
    """The share of its training that it had had."""
    score: float
    """The best evaluation until then."""


def passed(
    spec: SweepSpec, members: Sequence[TrialRecord], curves: Mapping[str, Sequence[Score]]
) -> tuple[Passed, ...]:
    """Return the rungs that all seeds of a point have passed, and what they had come to there.

    Args:
        spec: The sweep; the first rung is at its grace period, and each other at `reduction_factor` times as many env
            steps as the one before.
        members: The records of the point's trials that have ended.
        curves: Their evaluations.
    """
    found: list[Passed] = []
    steps = float(spec.grace_env_steps)
    while members:
        at = [_at(spec, record, curves.get(record.trial_id, ()), steps) for record in members]
        known = [each for each in at if each is not None]
        if len(known) < len(at):
            break
        steps *= spec.scheduler.reduction_factor
        mean = Passed(mean_of([each.trained for each in known]), mean_of([each.score for each in known]))
        # One evaluation may come after two rungs.
        if not found or mean.trained > found[-1].trained:
            found.append(mean)
    return tuple(found)


def mean_of(values: Sequence[float]) -> float:
    """Return the mean of some finite numbers; equal ones may have another mean by another order of sums and shares."""
    total = sum(values)
    # The sum of numbers near the ends of what a float can be may be infinite, where their mean is not.
    return total / len(values) if math.isfinite(total) else sum(value / len(values) for value in values)


def _at(spec: SweepSpec, record: TrialRecord, curve: Sequence[Score], steps: float) -> Passed | None:
    """Return what one trial had at its first evaluation of so many env steps; None: it had none before its end."""
    best = -math.inf
    for score in curve:
        best = max(best, score.value)
        if score.num_env_steps >= steps:
            if score.num_env_steps >= record.num_env_steps or not math.isfinite(best):
                return None
            whole = whole_length(
                record.point, record.hyperparams,
                num_env_steps=spec.stop.num_env_steps, num_iterations=spec.stop.num_iterations,
            )  # fmt: skip
            return Passed(min(1.0, score.num_env_steps / whole), best)
    return None

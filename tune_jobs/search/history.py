"""What a search method is told of the points that were tried before.

A point is known to a method by its values, by what became of each of its seeds, and by how far it got:

- ended: of each seed its score by the sweep's objective where its process told one (decision 53), else its best
  evaluation return; None for one that failed or showed nothing that can be scored, which counts as worse than all that
  did. A sweep begun by a former version, whose processes told none, goes on with the best evaluations;
- ended early by a scheduler: the same, and the rung that its first trial reached;
- with a scheduler, also of its seeds that have ended what they had come to at the rungs that they passed;
- running: the scores of those seeds that have ended, which are not like the others: what is solved ends early;
- planned, but not begun, or chosen by somebody with a value that the search could not give: nothing, as a model has no
  place for it.
"""

from __future__ import annotations

import functools
import math
import operator
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from analysis.objectives import env_steps_of
from analysis.records import FINISHED, Objective, TrialRecord, whole_length
from analysis.selection import score_trial
from tune_jobs.search.chosen_point import outside
from tune_jobs.search.rungs import Passed, ReadCurves, mean_of, passed
from tune_jobs.spec.sweep_spec import SweepSpec

TOLD: tuple[Objective, ...] = ("area", "steps_to_threshold")
"""The objectives whose scores a search learns of; with the others it learns of the best evaluation."""


@dataclass(frozen=True)
class KnownPoint:
    """A point that was tried, or is being tried."""

    point: Mapping[str, Any]
    """Its values by the names of the space."""
    scores: tuple[float | None, ...] = ()
    """What its ended seeds reached, higher is better, in reward units; None: that seed failed or was never scored."""
    env_steps: tuple[int, ...] = ()
    """What a training took, one for each of the scores; see `analysis.objectives.env_steps_of`. Empty: not known."""
    is_running: bool = False
    """Whether at least one of its seeds has not ended."""
    level: int | None = None
    """The rung at which a scheduler ended it; None: none did."""
    trained: float = 1.0
    """The share of its training that it has had, the mean over its ended seeds: below 1 if a scheduler ended it."""
    length: float | None = None
    """The share of a training after which its scores were reached; None: `trained`."""
    passed: tuple[Passed, ...] = ()
    """What it had come to at the rungs that it passed; empty: not known, or none."""
    is_own: bool = True
    """Whether it is one of this sweep; one of an earlier sweep tells a model as much, but was never tried in this."""

    @functools.cached_property
    def score(self) -> float | None:
        """The mean over its seeds; None: it has none, or one of them failed."""
        known = [score for score in self.scores if score is not None]
        if not known or len(known) < len(self.scores):
            return None
        return mean_of(known)


class History:
    """What a search method is told of the trials of a sweep that goes on: looked at anew is only what has changed.

    Args:
        spec: The sweep.
        with_outside: Whether points that its search could not have given are told, too, as to another sweep's.
        curves: Returns the evaluations of trials, from which follows what points had come to at the rungs that they
            passed; None: that is not told.
    """

    def __init__(self, spec: SweepSpec, *, with_outside: bool = False, curves: ReadCurves | None = None) -> None:
        self._spec, self._with_outside, self._curves = spec, with_outside, curves
        self._by_objective: bool | None = None
        self._seen: dict[int, tuple[list[TrialRecord], KnownPoint | None]] = {}
        """By point, its trials as they were when it was looked at, and what they told."""

    def known_points(self, records: Sequence[TrialRecord]) -> list[KnownPoint]:
        """Return what the trials tell of their points, in the order of the points.

        Args:
            records: The records of all trials of the sweep, in any order; those that have not changed may be the same
                objects as before, which saves time.
        """
        if self._by_objective is None:
            # Decided once, for all trials: scores of two kinds can't be compared.
            self._by_objective = tell_scores(records)
            if self._by_objective:
                self._seen.clear()  # until then the best evaluations were told
        points: defaultdict[int, list[TrialRecord]] = defaultdict(list)
        for record in records:
            if record.has_point:
                points[record.point_index].append(record)
        told = (self._told(index, points[index]) for index in sorted(points))
        return [point for point in told if point is not None]

    def _told(self, index: int, members: list[TrialRecord]) -> KnownPoint | None:
        seen = self._seen.get(index)
        # Records are not changed, but replaced.
        if seen is not None and len(seen[0]) == len(members) and all(map(operator.is_, seen[0], members)):
            return seen[1]
        score = _objective_score if self._by_objective else _best_evaluation
        is_told = self._with_outside or not outside(self._spec.space, members[0].point)
        found = _known(self._spec, sorted(members, key=lambda record: record.index), score) if is_told else None
        if found is not None and self._curves is not None and not (found.is_running or self._by_objective):
            found = replace(found, passed=self._passed(members))
        self._seen[index] = members, found
        return found

    def _passed(self, members: Sequence[TrialRecord]) -> tuple[Passed, ...]:
        assert self._curves is not None
        ended = [record for record in members if record.status in FINISHED]
        if any(record.status == "failed" for record in ended):
            return ()
        return passed(self._spec, ended, self._curves([record.trial_id for record in ended]))


def known_points(spec: SweepSpec, records: Sequence[TrialRecord]) -> list[KnownPoint]:
    """Return what the trials of a sweep tell of its points, in the order of the points.

    Args:
        spec: The sweep.
        records: The records of all its trials, in any order.
    """
    return History(spec).known_points(records)


def _known(
    spec: SweepSpec, members: Sequence[TrialRecord], score: Callable[[TrialRecord], float | None]
) -> KnownPoint | None:
    """Return what a model is told of a point; None: nothing.

    Args:
        spec: The sweep.
        members: The records of its trials that have a point, in their order.
        score: Returns what one that has ended scored; None: nothing.
    """
    if all(record.status == "pending" for record in members):
        return None
    ended = [record for record in members if record.status in FINISHED]
    return KnownPoint(
        point=members[0].point,
        scores=tuple(map(score, ended)),
        env_steps=tuple(env_steps_of(record, spec.stop.num_env_steps, spec.stop.num_iterations) for record in ended),
        is_running=any(record.status not in FINISHED for record in members if record.seed_index < spec.seeds_per_point),
        level=_level(spec, members),
        trained=sum(_trained(spec, record) for record in ended) / len(ended) if ended else 1.0,
    )


def _objective_score(record: TrialRecord) -> float | None:
    return None if record.status == "failed" else record.objective_score


def _best_evaluation(record: TrialRecord) -> float | None:
    scored = score_trial(record)
    return None if scored is None else scored.score


def tell_scores(records: Sequence[TrialRecord]) -> bool | None:
    """Return whether trials that ended with an evaluation have scores by the objective; None: none has ended so yet."""
    ended = [record for record in records if record.status in FINISHED and score_trial(record) is not None]
    return all(record.objective_score is not None for record in ended) if ended else None


def _trained(spec: SweepSpec, record: TrialRecord) -> float:
    """Return the share of its training that a trial has had: less than 1 if a scheduler ended it, or, with one, failed.

    Without a scheduler all are whole: what failed tells as much as it ever will, and nothing was ended early.
    """
    if record.status == "completed" or spec.scheduler.type == "none":
        return 1.0
    whole = whole_length(
        record.point, record.hyperparams, num_env_steps=spec.stop.num_env_steps, num_iterations=spec.stop.num_iterations
    )
    return min(1.0, record.num_env_steps / whole)


def _level(spec: SweepSpec, members: Sequence[TrialRecord]) -> int | None:
    """Return the rung that the first trial ended by a scheduler reached; None if the scheduler ended none."""
    steps = [record.num_env_steps for record in members if record.status == "stopped"]
    if not steps:
        return None
    # Trials end at a rung with slightly different env steps, which must not make a difference.
    rungs = math.log(max(1.0, min(steps) / spec.grace_env_steps), spec.scheduler.reduction_factor)
    return int(rungs + 1e-9)

"""What a trial has scored by its sweep's objective, which its process tells where a search method learns of it.

Where it tells none, a search learns of the best evaluation, which is in the record anyway. `best` asks for just that;
beside `final` it led to better settings on one of two tasks, and to worse ones on the other (decision 53).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from analysis.objectives import score_so_far
from analysis.records import IterationRecord, Objective, SweepRecord, whole_length
from policies.errors import SpecError
from policies.hyperparams import make_hyperparams
from tune_jobs.plan.estimates import planned_env_steps
from tune_jobs.search.points import largest_hyperparams
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.progress import Progress


@dataclass(frozen=True)
class Judging:
    """How a trial is judged; see `analysis.objectives.score_of`."""

    objective: Objective
    num_env_steps: int
    """The env steps that the trial is to have; for `steps_to_threshold` those of the longest."""
    threshold: float | None = None
    """The return to reach, for `steps_to_threshold`."""
    at_evaluations: bool = False
    """Whether a scheduler may end it after any evaluation; otherwise only its end is judged."""


def judging_of(
    spec: SweepSpec, sweep: SweepRecord, point: Mapping[str, Any], hyperparams: Mapping[str, Any] | None = None
) -> Judging | None:
    """Return how a trial is judged where a search method learns its score; None: none does, or can.

    Args:
        spec: The sweep.
        sweep: Its record, which has the env's own threshold.
        point: The trial's searched values, of which one may be how long it trains.
        hyperparams: All of its hyperparameters; None: it is judged as if `stop.num_env_steps` alone ended it.
    """
    objective, all_steps, compares = spec.objective, spec.stop.num_env_steps, spec.scheduler.type != "none"
    if spec.search.has_model and objective.type == "area":
        length = whole_length(
            point, hyperparams or {}, num_env_steps=all_steps, num_iterations=spec.stop.num_iterations
        )
        return Judging("area", length, at_evaluations=compares)
    # A record of a former version may not know the env's own.
    threshold = sweep.env_threshold if objective.threshold is None else objective.threshold
    if spec.search.has_model and objective.type == "steps_to_threshold" and threshold is not None:
        return Judging("steps_to_threshold", _longest(spec, hyperparams), threshold, at_evaluations=compares)
    return None


def _longest(spec: SweepSpec, hyperparams: Mapping[str, Any] | None) -> int:
    """Return the env steps of the longest trial that the sweep may have: all of its trials are told the same."""
    try:
        like = make_hyperparams(spec.algorithm, dict(hyperparams or {}))
        return max(planned_env_steps(spec, values) for values in largest_hyperparams(spec, [like]))
    except (ValidationError, SpecError):
        # Of a record that another version has written, or there are too many combinations to check.
        return spec.stop.num_env_steps


class RunningScore:
    """Scores one trial while it trains.

    Args:
        judging: How; None: no score is told.
    """

    def __init__(self, judging: Judging | None) -> None:
        self._judging = judging
        self._iterations: list[IterationRecord] = []
        self._score: float | None = None

    def begin(self, iterations: Iterable[IterationRecord]) -> None:
        """Begin with what there is of the trial."""
        self._iterations, self._score = [], None
        for record in iterations:
            self.add(record)

    def add(self, record: IterationRecord) -> None:
        """Add an iteration, with its evaluation if it has one."""
        if self._judging is not None:
            # Losses and lengths say nothing of it, and thousands of these are kept.
            self._iterations.append(record.model_copy(update={"learner": {}, "episode_lengths": ()}))

    def told(self, progress: Progress) -> Progress:
        """Return what the process tells, with the newest score."""
        judging = self._judging
        if judging is None:
            return progress
        is_over = progress.status in ("completed", "stopped")
        if is_over or (judging.at_evaluations and progress.evaluated):
            self._score = score_so_far(
                progress, self._iterations, judging.objective, num_env_steps=judging.num_env_steps,
                threshold=judging.threshold,
            )  # fmt: skip
        return progress.model_copy(update={"objective_score": self._score})

"""Ray Tune's early-stopping schedulers, acting on evaluation returns at numbers of env steps.

A trial reports about once a second so that the table moves, but only reports with a fresh evaluation may be compared:
the others repeat an old score at a new number of steps.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from ray.tune.schedulers import (
    ASHAScheduler,
    FIFOScheduler,
    HyperBandScheduler,
    MedianStoppingRule,
    TrialScheduler,
)

from tune_jobs.spec import SchedulerSpec

if TYPE_CHECKING:
    from ray.tune.execution.tune_controller import TuneController
    from ray.tune.experiment import Trial

METRIC = "score"
# What a trial reports whose evaluation is not a finite number: it must lose every comparison, and NaN loses none
# (`nan < cutoff` is False).
WORST_SCORE = -1e300


class _OnEvaluations(TrialScheduler):  # type: ignore[misc]
    """Mixin: passes on only results of an iteration that was evaluated."""

    def on_trial_result(self, tune_controller: TuneController, trial: Trial, result: dict[str, Any]) -> str:
        if not result.get("evaluated"):
            return str(TrialScheduler.CONTINUE)
        return str(super().on_trial_result(tune_controller, trial, result))


class EvaluationASHA(_OnEvaluations, ASHAScheduler):  # type: ignore[misc]
    """Asynchronous successive halving (Li et al. 2020)."""


class EvaluationHyperBand(_OnEvaluations, HyperBandScheduler):  # type: ignore[misc]
    """HyperBand (Li et al. 2018)."""


class EvaluationMedian(_OnEvaluations, MedianStoppingRule):  # type: ignore[misc]
    """Median stopping (Golovin et al. 2017)."""


def grace_env_steps(spec: SchedulerSpec, max_env_steps: int) -> int:
    """Env steps before which no trial is ended: the given number, or 1/20 of the cap."""
    return spec.grace_env_steps if spec.grace_env_steps is not None else max(1, max_env_steps // 20)


def build_scheduler(spec: SchedulerSpec, max_env_steps: int) -> TrialScheduler:
    """The scheduler of a sweep.

    Args:
        spec: Its settings.
        max_env_steps: The cap of a trial, `stop.num_env_steps`.
    """
    grace = grace_env_steps(spec, max_env_steps)
    common = {"metric": METRIC, "mode": "max"}
    if spec.type == "asha":
        return EvaluationASHA(
            time_attr="num_env_steps",
            max_t=max_env_steps,
            grace_period=min(grace, max_env_steps),
            reduction_factor=spec.reduction_factor,
            **common,
        )
    if spec.type == "hyperband":
        # Its brackets count in units of the grace period: in env steps they would want 50,000 trials for 50,000 steps.
        units = max(1, math.ceil(max_env_steps / grace))
        return EvaluationHyperBand(
            time_attr="grace_periods", max_t=units, reduction_factor=spec.reduction_factor, **common
        )
    if spec.type == "median":
        return EvaluationMedian(time_attr="num_env_steps", grace_period=grace, **common)
    return FIFOScheduler()

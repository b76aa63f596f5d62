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

from tune_jobs.spec.sections import SchedulerSpec

if TYPE_CHECKING:
    from ray.tune.execution.tune_controller import TuneController
    from ray.tune.experiment import Trial

METRIC = "score"
# What a trial reports whose evaluation is not a finite number: it must lose every comparison, and NaN loses none
# (`nan < cutoff` is False).
WORST_SCORE = -1e300


class OnEvaluations(TrialScheduler):  # type: ignore[misc]
    """Mixin: passes on only results of an iteration that was evaluated."""

    def on_trial_result(self, tune_controller: TuneController, trial: Trial, result: dict[str, Any]) -> str:
        """See `TrialScheduler`."""
        if not result.get("evaluated"):
            return str(TrialScheduler.CONTINUE)
        return str(super().on_trial_result(tune_controller, trial, result))


class _EndsUnscored(OnEvaluations):
    """Mixin: ends a trial whose evaluation is not a finite number, at its first after the grace period.

    Losing every comparison is not enough: the first trial to get somewhere is compared with none.
    """

    grace_env_steps = 1

    def on_trial_result(self, tune_controller: TuneController, trial: Trial, result: dict[str, Any]) -> str:
        score, num_env_steps = result.get(METRIC, WORST_SCORE), result["num_env_steps"]
        unscored = math.isnan(score) or score <= WORST_SCORE
        if result.get("evaluated") and unscored and num_env_steps >= self.grace_env_steps:
            return str(TrialScheduler.STOP)
        return super().on_trial_result(tune_controller, trial, result)


class EvaluationASHA(_EndsUnscored, ASHAScheduler):  # type: ignore[misc]
    """Asynchronous successive halving (Li et al. 2020)."""


class EvaluationHyperBand(_EndsUnscored, HyperBandScheduler):  # type: ignore[misc]
    """HyperBand (Li et al. 2018), with the bracket that ends most trials first, as there.

    Ray begins with the one that ends none, and small sweeps never come to another (2.60).
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        milestone = vars(self)["_get_r0"]
        # Rounded down it may be 0, before a trial's first evaluation.
        self._get_r0 = lambda num_halvings: max(1, milestone(num_halvings))

    def _create_bracket(self, position: int) -> Any:
        return super()._create_bracket(self._s_max_1 - 1 - position)


class EvaluationMedian(_EndsUnscored, MedianStoppingRule):  # type: ignore[misc]
    """Median stopping (Golovin et al. 2017)."""


def grace_env_steps(spec: SchedulerSpec, max_env_steps: int) -> int:
    """Env steps before which no trial is ended: the given number, or 1/20 of the cap."""
    return spec.grace_env_steps if spec.grace_env_steps is not None else max(1, max_env_steps // 20)


def waits_for_others(spec: SchedulerSpec) -> bool:
    """Whether the scheduler pauses trials until others have come as far.

    Tune counts paused trials as running ones: `max_concurrent_trials` would keep the others from ever starting, and the
    scheduler would compare only those few.
    """
    return spec.type in ("hyperband", "pbt")


def build_scheduler(spec: SchedulerSpec, max_env_steps: int) -> TrialScheduler:
    """The scheduler of a sweep.

    Args:
        spec: Its settings.
        max_env_steps: The cap of a trial, `stop.num_env_steps`.
    """
    grace = grace_env_steps(spec, max_env_steps)
    common = {"metric": METRIC, "mode": "max"}
    scheduler: TrialScheduler
    if spec.type == "asha":
        scheduler = EvaluationASHA(
            time_attr="num_env_steps",
            max_t=max_env_steps,
            grace_period=min(grace, max_env_steps),
            reduction_factor=spec.reduction_factor,
            **common,
        )
    elif spec.type == "hyperband":
        # Its brackets count in units of the grace period: in env steps they would want 50,000 trials for 50,000 steps.
        units = max(1, math.ceil(max_env_steps / grace))
        scheduler = EvaluationHyperBand(
            time_attr="grace_periods",
            max_t=units,
            reduction_factor=spec.reduction_factor,
            # The last ones end by the stop rules; milestones are rounded down, and would end them before the cap.
            stop_last_trials=False,
            **common,
        )
    elif spec.type == "median":
        scheduler = EvaluationMedian(time_attr="num_env_steps", grace_period=grace, **common)
    else:
        return FIFOScheduler()
    scheduler.grace_env_steps = grace
    return scheduler

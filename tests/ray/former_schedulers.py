"""Ray Tune's schedulers as they were handed to Tune, and to packs with faked trials, before there was a protocol.

What they decide is what is to be decided: the tests of `tune_jobs.ray_tune.scheduling` hold the two against each other.
"""

import dataclasses
import math
from typing import Any

from ray.tune.experiment import Trial
from ray.tune.schedulers import ASHAScheduler, HyperBandScheduler, MedianStoppingRule, TrialScheduler

from tune_jobs.ray_tune.scheduling import WORST_SCORE
from tune_jobs.spec.scheduler import SchedulerSpec


def _is_unscored(score: float) -> bool:
    return math.isnan(score) or score <= WORST_SCORE


class _EndsUnscored(TrialScheduler):  # type: ignore[misc]
    def on_trial_result(self, tune_controller: Any, trial: Any, result: dict[str, Any]) -> Any:
        if not result.get("evaluated"):
            return "CONTINUE"
        score = result.get("score", WORST_SCORE)
        if _is_unscored(score) and result["num_env_steps"] >= self.grace_env_steps:
            return "STOP"
        return super().on_trial_result(tune_controller, trial, result)


class _ASHA(_EndsUnscored, ASHAScheduler):  # type: ignore[misc]
    pass


class _Median(_EndsUnscored, MedianStoppingRule):  # type: ignore[misc]
    pass


def former(spec: SchedulerSpec, max_env_steps: int) -> Any:
    """The scheduler of a sweep; see `SchedulerSpec`, whose `grace_env_steps` is set."""
    grace = spec.grace_env_steps
    common = {"time_attr": "num_env_steps", "metric": "score", "mode": "max"}
    if spec.type == "asha":
        settings = {"max_t": max_env_steps, "grace_period": grace, "reduction_factor": spec.reduction_factor}
        made = _ASHA(stop_last_trials=False, **settings, **common)
    else:
        made = _Median(grace_period=grace, **common)
    made.grace_env_steps = grace
    return made


class FormerHyperBand(HyperBandScheduler):  # type: ignore[misc]
    """Ray's, beginning with the bracket that ends most trials; no first milestone is 0."""

    def __init__(self, grace_env_steps: int, **settings: Any) -> None:
        super().__init__(**settings)
        self._grace_env_steps = grace_env_steps
        milestone = vars(self)["_get_r0"]
        # Rounded down it may be 0, before a trial's first evaluation.
        self._get_r0 = lambda num_halvings: max(1, milestone(num_halvings))

    def _create_bracket(self, position: int) -> Any:
        return super()._create_bracket(self._s_max_1 - 1 - position)

    def on_trial_result(self, tune_controller: Any, trial: Any, result: dict[str, Any]) -> str:
        if not result.get("evaluated"):
            return str(TrialScheduler.CONTINUE)
        unscored = _is_unscored(result.get("score", WORST_SCORE))
        if unscored and result["num_env_steps"] >= self._grace_env_steps:
            return str(TrialScheduler.STOP)
        return str(super().on_trial_result(tune_controller, trial, result))


def former_hyperband(spec: SchedulerSpec, max_env_steps: int) -> Any:
    """HyperBand of a sweep; see `SchedulerSpec`, whose `grace_env_steps` is set."""
    grace = spec.grace_env_steps
    assert grace is not None
    return FormerHyperBand(
        grace, time_attr="grace_periods", metric="score", mode="max", max_t=max(1, math.ceil(max_env_steps / grace)),
        reduction_factor=spec.reduction_factor, stop_last_trials=False,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class FakedTrial:
    """What Tune's schedulers need of a trial."""

    trial_id: str
    status: str = Trial.RUNNING

    @property
    def config(self) -> dict[str, str]:
        return {"trial_id": self.trial_id}


@dataclasses.dataclass(frozen=True)
class FakedController:
    """What they need of the controller: the trials, of which some may wait."""

    live: tuple[FakedTrial, ...] = ()

    def get_live_trials(self) -> list[FakedTrial]:
        return list(self.live)

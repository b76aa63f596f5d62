"""Ray Tune's schedulers as they were handed to Tune, and to packs with faked trials, before there was a protocol.

What they decide is what is to be decided: the tests of `tune_jobs.ray_tune.scheduling` hold the two against each other.
"""

import dataclasses
import math
from typing import Any

from ray.tune.experiment import Trial
from ray.tune.schedulers import ASHAScheduler, MedianStoppingRule, TrialScheduler

from tune_jobs.ray_tune.scheduling import WORST_SCORE
from tune_jobs.spec.sections import SchedulerSpec


class _EndsUnscored(TrialScheduler):  # type: ignore[misc]
    def on_trial_result(self, tune_controller: Any, trial: Any, result: dict[str, Any]) -> Any:
        if not result.get("evaluated"):
            return "CONTINUE"
        score = result.get("score", WORST_SCORE)
        if (math.isnan(score) or score <= WORST_SCORE) and result["num_env_steps"] >= self.grace_env_steps:
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
        made = _ASHA(max_t=max_env_steps, grace_period=grace, reduction_factor=spec.reduction_factor, **common)
    else:
        made = _Median(grace_period=grace, **common)
    made.grace_env_steps = grace
    return made


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

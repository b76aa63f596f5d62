"""Stop trials early by Ray Tune's schedulers, which compare evaluation returns at numbers of env steps.

A trial reports about once a second so that the live table is current, but only reports with a new evaluation may be
compared: the others repeat an old score at a new number of steps.

ASHA and median stopping look at one trial at a time: `RayRule` asks them, both for packs and for single trials. With
HyperBand (`tune_jobs.ray_tune.hyperband`) and in populations (`tune_jobs.ray_tune.population`) trials wait for each
other; in packs they do so by `tune_jobs.ray_tune.meetings`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ray.tune.experiment import Trial
from ray.tune.schedulers import ASHAScheduler, MedianStoppingRule, TrialScheduler

from tune_jobs.ray_tune.hyperband import HyperBand, HyperBandScheduler
from tune_jobs.ray_tune.median_stopping import MedianStopping
from tune_jobs.ray_tune.scheduling import Decision, EveryoneGoesOn, Others, Scheduler, Standing, is_unscored
from tune_jobs.ray_tune.tune_scheduler import METRIC, TuneScheduler
from tune_jobs.spec.scheduler import SchedulerSpec


@dataclass(frozen=True)
class _Named:
    """The attributes of a trial that Ray's rules read: its id and its status."""

    trial_id: str
    status: str = Trial.RUNNING


@dataclass(frozen=True)
class _Waiting:
    """The part of Tune's controller that Ray's rules read: median stopping asks which trials wait for a place."""

    others: Others

    def get_live_trials(self) -> list[_Named]:
        """Return one waiting trial if any waits, because Ray's rule does not count them."""
        return [_Named("", Trial.PENDING)] if self.others.wait() else []


_DECISIONS = {
    TrialScheduler.CONTINUE: Decision.GO_ON,
    TrialScheduler.STOP: Decision.STOP,
    TrialScheduler.PAUSE: Decision.GIVE_WAY,
}


class RayRule:
    """A `Scheduler` by one of Ray's rules that look at one trial at a time; of them it uses no private member.

    A trial whose evaluation is not a finite number is ended at its first evaluation after the grace period. That it
    loses every comparison is not enough, because the first trial to reach a rung is compared with none.

    Args:
        rule: Ray's rule, which compares `score` at `num_env_steps`.
        grace_env_steps: Env steps before which no trial is ended.
    """

    def __init__(self, rule: ASHAScheduler | MedianStoppingRule, grace_env_steps: int) -> None:
        self._rule = rule
        self._grace_env_steps = grace_env_steps

    def begins(self, trial_id: str) -> None:
        """Tell Ray's rule of a new trial."""
        self._rule.on_trial_add(None, _Named(trial_id))

    def reached(self, standing: Standing, others: Others) -> Decision:
        """Decide by Ray's rule, if the trial has a new evaluation."""
        if not standing.evaluated:
            return Decision.GO_ON
        if is_unscored(standing.score) and standing.num_env_steps >= self._grace_env_steps:
            return Decision.STOP
        told = self._rule.on_trial_result(_Waiting(others), _Named(standing.trial_id), _result(standing))
        return _DECISIONS[told]

    def ended(self, standing: Standing) -> None:
        """Tell Ray's rule of a trial's end, and of its score there if it has one.

        A trial that failed has the score of an evaluation before, which is none at the env steps at which it failed.
        """
        if not standing.evaluated:
            self._rule.on_trial_remove(None, _Named(standing.trial_id))
            return
        self._rule.on_trial_complete(None, _Named(standing.trial_id), _result(standing))


def _result(standing: Standing) -> dict[str, Any]:
    """Return a trial's standing in the form that Ray's rules read."""
    return {"num_env_steps": standing.num_env_steps, METRIC: standing.score}


def grace_env_steps(spec: SchedulerSpec, max_env_steps: int) -> int:
    """Return the env steps before which no trial is ended: the given number, or 1/20 of the cap."""
    return spec.grace_env_steps if spec.grace_env_steps is not None else max(1, max_env_steps // 20)


def build_scheduler(spec: SchedulerSpec, max_env_steps: int) -> Scheduler:
    """Return the scheduler of a sweep whose trials do not wait for each other.

    Args:
        spec: The scheduler's settings.
        max_env_steps: The cap of a trial, `stop.num_env_steps`.
    """
    grace = grace_env_steps(spec, max_env_steps)
    common = {"metric": METRIC, "mode": "max", "time_attr": "num_env_steps"}
    if spec.type == "asha":
        # Li et al. 2020.
        rung = min(grace, max_env_steps)
        # By default, Ray's files later scores of a trial at the rungs that it has passed between two evaluations, and
        # those whose evaluations are closer are compared with them. That `max_t` ends a trial is not needed here.
        asha = ASHAScheduler(
            max_t=max_env_steps, grace_period=rung, reduction_factor=spec.reduction_factor, stop_last_trials=False,
            **common,
        )  # fmt: skip
        return RayRule(asha, grace)
    if spec.type == "median":
        # Golovin et al. 2017.
        return RayRule(MedianStopping(grace_period=grace, **common), grace)
    if spec.type == "none":
        return EveryoneGoesOn()
    raise ValueError(f"Trials wait for each other with {spec.type}, which is no scheduler of this kind.")


def build_tune_scheduler(spec: SchedulerSpec, max_env_steps: int) -> TrialScheduler:
    """Return the scheduler in the form that Ray Tune takes, also for HyperBand; see `build_scheduler`."""
    if spec.type != "hyperband":
        return TuneScheduler(build_scheduler(spec, max_env_steps))
    grace = grace_env_steps(spec, max_env_steps)
    return HyperBandScheduler(HyperBand(grace, max_env_steps, spec.reduction_factor))

"""Stop trials early by Ray Tune's schedulers, which compare evaluation returns at numbers of env steps.

A trial reports about once a second so that the live table is current, but only reports with a new evaluation may be
compared: the others repeat an old score at a new number of steps.

ASHA and median stopping look at one trial at a time: `RayRule` asks them, both for packs and for single trials.
HyperBand pauses and unpauses trials in Tune's controller, so Tune's own scheduler is used, and packs cannot use it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ray.tune.experiment import Trial
from ray.tune.schedulers import (
    ASHAScheduler,
    FIFOScheduler,
    HyperBandScheduler,
    MedianStoppingRule,
    TrialScheduler,
)
from typing_extensions import override

from tune_jobs.ray_tune.scheduling import (
    WORST_SCORE,
    Decision,
    EveryoneGoesOn,
    Others,
    Scheduler,
    Standing,
)
from tune_jobs.spec.sections import SchedulerSpec

if TYPE_CHECKING:
    from ray.tune.execution.tune_controller import TuneController

METRIC = "score"


def is_unscored(score: float) -> bool:
    """Whether an evaluation was not a finite number."""
    return math.isnan(score) or score <= WORST_SCORE


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
    """A `Scheduler` by one of Ray's rules that look at one trial at a time; no private member of Ray is used.

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
        """Tell Ray's rule of a trial's end."""
        self._rule.on_trial_complete(None, _Named(standing.trial_id), _result(standing))


def _result(standing: Standing) -> dict[str, Any]:
    """Return a trial's standing in the form that Ray's rules read."""
    return {"num_env_steps": standing.num_env_steps, METRIC: standing.score}


class TuneScheduler(FIFOScheduler):  # type: ignore[misc]
    """Connects a `Scheduler` to Ray Tune; trials begin in their order.

    Args:
        scheduler: The scheduler that decides.
    """

    def __init__(self, scheduler: Scheduler) -> None:
        super().__init__()
        self.scheduler = scheduler

    @override
    def on_trial_add(self, tune_controller: TuneController, trial: Trial) -> None:
        self.scheduler.begins(name_of(trial))

    @override
    def on_trial_result(self, tune_controller: TuneController, trial: Trial, result: dict[str, Any]) -> str:
        decision = self.scheduler.reached(standing_of(trial, result), OfTune(tune_controller))
        # Copying needs the trial to be paused, which `PopulationScheduler` does.
        assert decision in _DECISIONS.values()
        return str(next(theirs for theirs, ours in _DECISIONS.items() if ours is decision))

    @override
    def on_trial_complete(
        self,
        tune_controller: TuneController,
        trial: Trial,
        result: dict[str, Any],
    ) -> None:
        # A trial that ends before its first report has no standing.
        if METRIC in result:
            self.scheduler.ended(standing_of(trial, result))


@dataclass(frozen=True)
class OfTune:
    """The other trials, as Tune's controller knows them; implements `Others`."""

    controller: TuneController

    def wait(self) -> bool:
        """Whether a trial waits for a place."""
        return any(trial.status in (Trial.PENDING, Trial.PAUSED) for trial in self.controller.get_live_trials())

    def ended(self) -> set[str]:
        """Return the ids of the trials that have ended."""
        return {name_of(trial) for trial in self.controller.get_trials() if trial.is_finished()}


def name_of(trial: Trial) -> str:
    """Return our id of one of Tune's trials."""
    return str(trial.config["trial_id"])


def standing_of(trial: Trial, result: dict[str, Any]) -> Standing:
    """Return a trial's standing by its report."""
    return Standing(name_of(trial), result["num_env_steps"], result[METRIC], bool(result.get("evaluated")))


class EvaluationHyperBand(HyperBandScheduler):  # type: ignore[misc]
    """HyperBand (Li et al. 2018), which begins with the bracket that ends the most trials, as in the paper.

    Ray begins with the bracket that ends none, and small sweeps never reach another; there is no setting for it (2.60).
    So three private members are used: `_create_bracket`, which makes the bracket at a position; `_s_max_1`, the number
    of brackets; and `_get_r0`, a bracket's first milestone, which must not be 0.

    Args:
        grace_env_steps: Env steps before which no trial is ended.
        settings: The settings of Ray's HyperBand.
    """

    def __init__(self, grace_env_steps: int, **settings: Any) -> None:
        super().__init__(**settings)
        self._grace_env_steps = grace_env_steps
        milestone = vars(self)["_get_r0"]
        # Rounded down, it may be 0, which is before a trial's first evaluation.
        self._get_r0 = lambda num_halvings: max(1, milestone(num_halvings))

    def _create_bracket(self, position: int) -> Any:
        return super()._create_bracket(self._s_max_1 - 1 - position)

    def on_trial_result(self, tune_controller: TuneController, trial: Trial, result: dict[str, Any]) -> str:
        """Decide what a trial does next; one without a finite score is ended, as by `RayRule`."""
        if not result.get("evaluated"):
            return str(TrialScheduler.CONTINUE)
        unscored = is_unscored(result.get(METRIC, WORST_SCORE))
        if unscored and result["num_env_steps"] >= self._grace_env_steps:
            return str(TrialScheduler.STOP)
        return str(super().on_trial_result(tune_controller, trial, result))


def grace_env_steps(spec: SchedulerSpec, max_env_steps: int) -> int:
    """Return the env steps before which no trial is ended: the given number, or 1/20 of the cap."""
    return spec.grace_env_steps if spec.grace_env_steps is not None else max(1, max_env_steps // 20)


def waits_for_others(spec: SchedulerSpec) -> bool:
    """Whether the scheduler pauses trials until others have reached the same number of env steps.

    Tune counts paused trials as running: with `max_concurrent_trials`, the others would never start, and the scheduler
    would compare only those few.
    """
    return spec.type in ("hyperband", "pbt")


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
        asha = ASHAScheduler(max_t=max_env_steps, grace_period=rung, reduction_factor=spec.reduction_factor, **common)
        return RayRule(asha, grace)
    if spec.type == "median":
        # Golovin et al. 2017.
        return RayRule(MedianStoppingRule(grace_period=grace, **common), grace)
    if spec.type == "none":
        return EveryoneGoesOn()
    raise ValueError(f"{spec.type} pauses trials, so Ray Tune's own scheduler has to be used.")


def build_tune_scheduler(spec: SchedulerSpec, max_env_steps: int) -> TrialScheduler:
    """Return the scheduler in the form that Ray Tune takes, also for HyperBand; see `build_scheduler`."""
    if spec.type != "hyperband":
        return TuneScheduler(build_scheduler(spec, max_env_steps))
    grace = grace_env_steps(spec, max_env_steps)
    return EvaluationHyperBand(
        grace,
        time_attr="grace_periods",
        metric=METRIC,
        mode="max",
        # Its brackets count in grace periods: counted in env steps, they would need 50,000 trials for 50,000 steps.
        max_t=max(1, math.ceil(max_env_steps / grace)),
        reduction_factor=spec.reduction_factor,
        # The last trials end by the stop rules: milestones are rounded down, and would end them before the cap.
        stop_last_trials=False,
    )

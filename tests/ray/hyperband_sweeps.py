"""Random sweeps that HyperBand decides about, with trials and a controller that show what Tune's show to schedulers."""

import math
from collections.abc import Callable, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from ray.tune.experiment import Trial

from tune_jobs.ray_tune.scheduling import WORST_SCORE
from tune_jobs.spec.scheduler import SchedulerSpec

MAX_ENV_STEPS = 1_600


class FakedTrial:
    """What schedulers see of a trial of Tune's."""

    is_saving = False

    def __init__(self, number: int) -> None:
        self.trial_id = f"t{number:04d}"
        self.config = {"trial_id": self.trial_id}
        self.status = Trial.PENDING
        self.num_env_steps = 0

    def is_finished(self) -> bool:
        return self.status in (Trial.TERMINATED, Trial.ERROR)


class Controller:
    """Tune's; whom it is told to stop is noted. No process takes any time to start."""

    _trial_to_actor = MappingProxyType[Any, Any]({})

    def __init__(self, trials: Sequence[FakedTrial], scheduler: Any, grace_env_steps: int) -> None:
        self.grace_env_steps = grace_env_steps
        self._trials = trials
        self._scheduler = scheduler
        self._stopped: list[str] = []

    def get_trials(self) -> list[FakedTrial]:
        return list(self._trials)

    def get_live_trials(self) -> list[FakedTrial]:
        return [trial for trial in self._trials if not trial.is_finished()]

    def stop_trial(self, trial: FakedTrial) -> None:
        assert trial.status in (Trial.PENDING, Trial.PAUSED)
        self._scheduler.on_trial_remove(self, trial)
        trial.status = Trial.TERMINATED
        self._stopped.append(trial.trial_id)

    def take_stopped(self) -> list[str]:
        stopped, self._stopped = self._stopped, []
        return stopped


def decided(
    seed: int, make: Callable[[SchedulerSpec, int], Any], *, every: Sequence[int] = (100, 200, 300)
) -> tuple[list[Any], bool]:
    """Everything that is decided in a random sweep, and whether all its trials came to an end.

    Args:
        seed: Of the draws.
        make: Settings and the cap of a trial -> Tune's scheduler.
        every: Env steps from one report to the next.
    """
    rng = np.random.default_rng(seed)
    grace = int(rng.choice([50, 100, 200, 400]))
    settings = SchedulerSpec(type="hyperband", grace_env_steps=grace, reduction_factor=float(rng.choice([2, 3, 2.5])))
    scheduler = make(settings, MAX_ENV_STEPS)
    trials = [FakedTrial(number) for number in range(int(rng.integers(1, 30)))]
    controller = Controller(trials, scheduler, grace)
    slots, fails = int(rng.integers(1, 9)), float(rng.choice([0.0, 0.0, 0.03]))
    for trial in trials:
        scheduler.on_trial_add(controller, trial)
    found: list[Any] = []
    while controller.get_live_trials():
        running = [trial for trial in trials if trial.status == Trial.RUNNING]
        chosen = scheduler.choose_trial_to_run(controller) if len(running) < slots else None
        if chosen is not None:
            assert chosen.status in (Trial.PENDING, Trial.PAUSED)
            chosen.status = Trial.RUNNING
            found.append(("runs", chosen.trial_id))
        elif not running:
            return found, False
        else:
            trial = running[int(rng.integers(len(running)))]
            what = _failed(trial, scheduler, controller, rng) if rng.random() < fails else ""
            if not what:
                trial.num_env_steps += int(rng.choice(every))
                what = _reported(trial, scheduler, controller, rng)
            found.append((what, trial.trial_id, controller.take_stopped()))
    return found, True


def _failed(trial: FakedTrial, scheduler: Any, controller: Controller, rng: np.random.Generator) -> str:
    if rng.random() < 0.5:
        trial.status = Trial.PENDING
        return "tried again"
    scheduler.on_trial_error(controller, trial)
    trial.status = Trial.ERROR
    return "failed"


def _reported(trial: FakedTrial, scheduler: Any, controller: Controller, rng: np.random.Generator) -> str:
    steps = trial.num_env_steps
    # Few values, so that there are ties; and no numbers.
    score = float(rng.choice([WORST_SCORE, math.nan])) if rng.random() < 0.05 else float(rng.integers(0, 6))
    over = steps >= MAX_ENV_STEPS or rng.random() < 0.01
    result = {
        "num_env_steps": steps, "grace_periods": steps / controller.grace_env_steps, "score": score,
        "evaluated": bool(over or rng.random() < 0.7),
    }  # fmt: skip
    decision = "STOP" if over else str(scheduler.on_trial_result(controller, trial, result))
    if decision == "STOP":
        scheduler.on_trial_complete(controller, trial, result)
        trial.status = Trial.TERMINATED
    elif decision == "PAUSE":
        trial.status = Trial.PAUSED
    return decision

"""Connects a scheduler of ours to Ray Tune, and tells the scheduler what it may know of Tune's trials."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ray.tune.experiment import Trial
from ray.tune.schedulers import FIFOScheduler, TrialScheduler
from typing_extensions import override

from tune_jobs.ray_tune.scheduling import Decision, Scheduler, Standing

if TYPE_CHECKING:
    from ray.tune.execution.tune_controller import TuneController

METRIC = "score"
"""The field of a report by which trials are compared."""

_IN_TUNES_WORDS = {
    Decision.GO_ON: TrialScheduler.CONTINUE,
    Decision.STOP: TrialScheduler.STOP,
    Decision.GIVE_WAY: TrialScheduler.PAUSE,
    Decision.WAIT: TrialScheduler.PAUSE,
}


class TuneScheduler(FIFOScheduler):  # type: ignore[misc]
    """Connects a `Scheduler` to Ray Tune; trials begin in their order.

    Args:
        scheduler: The scheduler that decides.
    """

    def __init__(self, scheduler: Scheduler) -> None:
        super().__init__()
        self.scheduler = scheduler
        self._begun: set[str] = set()

    @override
    def on_trial_add(self, tune_controller: TuneController, trial: Trial) -> None:
        # Tune (2.60) adds a trial again with each retry.
        if (name := name_of(trial)) not in self._begun:
            self._begun.add(name)
            self.scheduler.begins(name)

    @override
    def choose_trial_to_run(self, tune_controller: TuneController) -> Trial | None:
        # Of those that run or wait: Ray's own looks at all trials, those that have ended too, at each of its events.
        waiting = [trial for trial in tune_controller.get_live_trials() if trial.status == Trial.PENDING]
        if waiting:
            waiting = [trial for trial in waiting if not is_starting(tune_controller, trial)]
        else:
            waiting = [trial for trial in tune_controller.get_live_trials() if trial.status == Trial.PAUSED]
        return min(waiting, key=_order_of, default=None)

    @override
    def on_trial_result(self, tune_controller: TuneController, trial: Trial, result: dict[str, Any]) -> str:
        decision = self.scheduler.reached(standing_of(trial, result), OfTune(tune_controller))
        # Copying needs the trial to be paused, which `PopulationScheduler` does.
        assert isinstance(decision, Decision)
        return str(_IN_TUNES_WORDS[decision])

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


def is_starting(tune_controller: TuneController, trial: Trial) -> bool:
    """Whether a process is started for a trial, which has its place already.

    Tune (2.60) gives a trial that is chosen the process of one that has ended, and ends the one that is started for it;
    for the next trial it then starts another one. Where trials are shorter than the start of a process, processes
    would be started and ended all the time, and never as many run as there are places. So such a trial is not chosen:
    the next one, which has none, takes the process that is there. Nothing public tells which they are.
    """
    controller = getattr(tune_controller, "_tune_controller", tune_controller)
    actor = controller._trial_to_actor.get(trial)  # noqa: SLF001
    return actor is not None and bool(controller._actor_manager.is_actor_started(actor))  # noqa: SLF001


def _order_of(trial: Trial) -> tuple[int, str]:
    """Trials are numbered; the numbers of more than 10,000 have more digits than those of the first."""
    return len(name_of(trial)), name_of(trial)


def name_of(trial: Trial) -> str:
    """Return our id of one of Tune's trials."""
    return str(trial.config["trial_id"])


def standing_of(trial: Trial, result: dict[str, Any]) -> Standing:
    """Return a trial's standing by its report."""
    return Standing(name_of(trial), result["num_env_steps"], result[METRIC], bool(result.get("evaluated")))

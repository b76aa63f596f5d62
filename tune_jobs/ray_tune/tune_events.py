"""What Ray Tune says of trials and packs while it runs them, told to those who keep their records."""

from __future__ import annotations

from typing import Any

from ray import tune
from ray.tune.experiment import Trial

from tune_jobs.ray_tune.failures import describe_failure, was_lost
from tune_jobs.ray_tune.lost_nodes import NodeLosses
from tune_jobs.ray_tune.pack_driver import PackDriver
from tune_jobs.ray_tune.processes import RayWatch
from tune_jobs.store.contract import Sweep
from tune_jobs.store.progress import Progress
from tune_jobs.store.record_keeper import RecordKeeper


def trial_id_of(trial: Trial) -> str:
    """Return the trial that one of Tune's trials runs."""
    return str(trial.config["trial_id"])


def pack_id_of(trial: Trial) -> str:
    """Return the pack that one of Tune's trials runs."""
    return str(trial.config["pack_id"])


class TrialEvents(tune.Callback):  # type: ignore[misc]
    """Tells the keeper of records what Tune does with the trials."""

    def __init__(
        self, store: Sweep, keeper: RecordKeeper, timeout_s: float, watch: RayWatch, losses: NodeLosses
    ) -> None:
        self._store = store
        self._keeper = keeper
        self._timeout_s = timeout_s
        self._losses = losses
        self._watch = watch
        self._started: dict[str, Trial] = {}
        """Tune's trials that were begun and not seen paused since."""

    def on_trial_start(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """Note that a process has begun the trial."""
        self._started[trial_id_of(trial)] = trial
        self._keeper.started(trial_id_of(trial))

    def on_trial_result(
        self,
        iteration: int,
        trials: list[Trial],
        trial: Trial,
        result: dict[str, Any],
        **info: Any,
    ) -> None:
        """Take a trial's report, which comes about once a second and after each evaluation.

        It is taken out of the result, as Tune keeps the last result of every trial until the end of the run.
        """
        progress: Progress = result.pop("progress").report
        self._keeper.progressed(trial_id_of(trial), progress, node=result["node"], pid=result["pid"])

    def on_step_end(self, iteration: int, trials: list[Trial], **info: Any) -> None:
        """Note paused trials, which schedulers do not report; they have saved and need not be waited for."""
        # Tune calls this at each of its events: of 10,000 trials, a look at all would cost more than the event.
        for trial_id in [name for name in self._started if name not in self._keeper.running]:
            del self._started[trial_id]
        for trial_id, trial in list(self._started.items()):
            if trial.status == Trial.PAUSED:
                del self._started[trial_id]
                self._keeper.paused(trial_id)
        self._keeper.flush()

    def on_trial_complete(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """Note a trial's end: its own, the scheduler's decision, or the end of the run."""
        trial_id = trial_id_of(trial)
        if self._keeper.record(trial_id).status == "pending" and not self._keeper.stop_requested():
            # The scheduler ends one that was to be tried again.
            self._keeper.started(trial_id)
        self._keeper.ended(trial_id)

    def on_trial_recover(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """Note a failure that will be retried."""
        self._failed(trial, retried=True)

    def on_trial_error(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """Note a failure that will not be retried."""
        self._failed(trial, retried=False)

    def _failed(self, trial: Trial, *, retried: bool) -> None:
        trial_id, error = trial_id_of(trial), self._losses.error_of(trial)
        if was_lost(error):
            self._keeper.lost(trial_id)
            return
        if left := self._losses.take(trial):
            self._keeper.moved(trial_id, left)
            return
        self._watch.check_after(error)
        message = describe_failure(error, self._store.trial(trial_id).log_tail(), timeout_s=self._timeout_s)
        self._keeper.failed(trial_id, message, retried=retried)

    def __getstate__(self) -> dict[str, Any]:
        # Tune pickles its callbacks into a file that is never read back here; listeners and open files can't be.
        return {}


class PackEvents(tune.Callback):  # type: ignore[misc]
    """Tells the driver of the packs what happens to their processes."""

    def __init__(
        self, driver: PackDriver, keeper: RecordKeeper, timeout_s: float, watch: RayWatch, losses: NodeLosses
    ) -> None:
        self._losses = losses
        self._watch = watch
        self._driver = driver
        self._keeper = keeper
        self._timeout_s = timeout_s

    def on_trial_start(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """Note that the pack's process runs."""
        self._driver.started(pack_id_of(trial))

    def on_trial_result(
        self,
        iteration: int,
        trials: list[Trial],
        trial: Trial,
        result: dict[str, Any],
        **info: Any,
    ) -> None:
        """Drop the report, which the scheduler has taken, so that Tune does not keep it."""
        del result["reports"], result["process"]

    def on_step_end(self, iteration: int, trials: list[Trial], **info: Any) -> None:
        """Do the work that packs need not wait for, now that they continue."""
        self._keeper.flush()

    def on_trial_complete(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """Note the end of the pack's process: it has nothing to do, or the run ends."""
        self._driver.closed(pack_id_of(trial))

    def on_trial_recover(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """Note that the pack's process died; Tune starts another one."""
        pack_id, tail, error = pack_id_of(trial), self._driver.log_tail(pack_id_of(trial)), self._losses.error_of(trial)
        if was_lost(error):
            self._driver.lost(pack_id)
            return
        if left := self._losses.take(trial):
            self._driver.moved(pack_id, left)
            return
        self._watch.check_after(error)
        self._driver.died(pack_id, describe_failure(error, tail, timeout_s=self._timeout_s, what="pack"))

    def on_trial_error(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """Note that the pack's process died too often."""
        self.on_trial_recover(iteration, trials, trial)
        self._driver.closed(pack_id_of(trial))

    def __getstate__(self) -> dict[str, Any]:
        return {}

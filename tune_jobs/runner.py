"""Runs a sweep's trials with Ray Tune, and keeps their records up to date.

Tune decides which trial runs where and when; what a trial is and how far it got is in the sweep folder, written here
(`trial.json`) and by the trials' own processes. Tune's own folder is a cache that every run begins anew.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cloudpickle
from ray import tune
from ray.exceptions import RayActorError, RayTaskError
from ray.tune.experiment import Trial
from ray.tune.schedulers import TrialScheduler

from analysis.records import CheckpointRecord, TrialRecord
from policies.errors import TuneJobsError
from tune_jobs.population import PopulationScheduler
from tune_jobs.ray_environment import prepare_environment
from tune_jobs.schedulers import build_scheduler, waits_for_others
from tune_jobs.searcher import PointSearcher
from tune_jobs.spec import SweepSpec
from tune_jobs.store import SweepStore
from tune_jobs.tensorboard import ScalarWriter
from tune_jobs.trainable import TrialTrainable

Listener = Callable[[TrialRecord], None]

# How long running trials may take to save a checkpoint once they were asked to stop; then they are ended.
STOP_GRACE_S = 20.0


@dataclass(frozen=True)
class RunJob:
    """What to run."""

    sweep_folder: Path
    trial_ids: tuple[str, ...]
    cpus_per_trial: float
    gpus_per_trial: float
    max_concurrent: int


def run_trials(job: RunJob, listener: Listener) -> None:
    """Run these trials to their end, or until the sweep is asked to stop. Failed trials raise nothing.

    Args:
        job: What to run; Ray must be connected.
        listener: Called with a trial's record whenever it changes, in this thread.
    """
    prepare_environment()
    store = SweepStore(job.sweep_folder)
    spec = SweepSpec.model_validate(store.read_record().spec)
    keeper = RecordKeeper(store, job.trial_ids, listener)
    shutil.rmtree(store.tune_folder, ignore_errors=True)
    param_space: dict[str, Any] = {"sweep_folder": str(store.folder)}
    searcher = None
    if spec.search.type == "tpe":
        searcher = PointSearcher(spec, job.trial_ids, keeper.all_records, keeper.change)
    else:
        param_space["trial_id"] = tune.grid_search(list(job.trial_ids))
    tuner = tune.Tuner(
        tune.with_resources(TrialTrainable, _resources(spec, job)),
        param_space=param_space,
        tune_config=tune.TuneConfig(
            search_alg=searcher,
            num_samples=1 if searcher is None else len(job.trial_ids),
            scheduler=_scheduler(spec, store, keeper),
            # Without it Tune runs one trial at a time where there is a searcher.
            max_concurrent_trials=None if waits_for_others(spec.scheduler) else job.max_concurrent,
            reuse_actors=True,
            trial_name_creator=_trial_id,
            trial_dirname_creator=_trial_id,
        ),
        run_config=tune.RunConfig(
            name="run",
            storage_path=str(store.tune_folder),
            stop=_StopWhenAsked(store, keeper),
            verbose=0,
            failure_config=tune.FailureConfig(max_failures=spec.max_retries),
            # Trials write their own checkpoints; Tune's are pointers, made when it pauses one.
            checkpoint_config=tune.CheckpointConfig(checkpoint_frequency=0, checkpoint_at_end=False),
            callbacks=[keeper],
        ),
    )
    try:
        tuner.fit()
    finally:
        keeper.close()


def _scheduler(spec: SweepSpec, store: SweepStore, keeper: RecordKeeper) -> TrialScheduler:
    if spec.scheduler.type == "pbt":
        return PopulationScheduler(spec, store, keeper.record, keeper.change)
    return build_scheduler(spec.scheduler, spec.stop.num_env_steps)


def _trial_id(trial: Trial) -> str:
    return str(trial.config["trial_id"])


def _resources(spec: SweepSpec, job: RunJob) -> tune.PlacementGroupFactory:
    """One bundle for the trial's process, one for each env runner; together `cpus_per_trial`."""
    num_runners = spec.resources.num_env_runners
    main = {"CPU": job.cpus_per_trial - num_runners}
    if job.gpus_per_trial:
        main["GPU"] = job.gpus_per_trial
    return tune.PlacementGroupFactory([main] + [{"CPU": 1}] * num_runners, strategy="PACK")


class _StopWhenAsked(tune.Stopper):  # type: ignore[misc]
    """Ends the run once the running trials have saved their checkpoints, or took too long to."""

    def __init__(self, store: SweepStore, keeper: RecordKeeper) -> None:
        self._store = store
        self._keeper = keeper
        self._asked_at: float | None = None

    def __call__(self, trial_id: str, result: dict[str, Any]) -> bool:
        return False

    def stop_all(self) -> bool:
        """Whether to end the run now."""
        if self._asked_at is None:
            if not self._store.stop_requested():
                return False
            self._asked_at = time.monotonic()
        return not self._keeper.running or time.monotonic() - self._asked_at > STOP_GRACE_S


class RecordKeeper(tune.Callback):  # type: ignore[misc]
    """Turns Tune's events into trial records, on disk and for the listener."""

    def __init__(self, store: SweepStore, trial_ids: Sequence[str], listener: Listener) -> None:
        self._store = store
        self._records = {name: store.trial(name).read_record() for name in trial_ids}
        self._others = [record for record in store.read_trials() if record.trial_id not in self._records]
        self._listener = listener
        self._scalars = ScalarWriter(store.folder)
        self.running: set[str] = set()

    def record(self, trial_id: str) -> TrialRecord:
        """A trial's newest record."""
        return self._records[trial_id]

    def all_records(self) -> list[TrialRecord]:
        """The newest record of every trial of the sweep, those of earlier runs too."""
        return sorted([*self._others, *self._records.values()], key=lambda record: record.index)

    def change(self, trial_id: str, **changes: Any) -> None:
        """Change fields of a trial's record."""
        record = self._records[trial_id].model_copy(update=changes)
        self._records[trial_id] = record
        self._store.trial(trial_id).write_record(record)
        self._listener(record)

    def on_trial_start(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """A process took the trial."""
        trial_id = _trial_id(trial)
        self.running.add(trial_id)
        before = self._records[trial_id].started_at
        started_at = time.time() if before is None else before
        self.change(trial_id, status="running", started_at=started_at, ended_at=None, error=None)

    def on_trial_result(
        self,
        iteration: int,
        trials: list[Trial],
        trial: Trial,
        result: dict[str, Any],
        **info: Any,
    ) -> None:
        """A report, about once a second and after each evaluation."""
        trial_id = _trial_id(trial)
        fields = dict(result["progress"])
        evaluated, status = fields.pop("evaluated"), fields.pop("status")
        fields["num_iterations"] = fields.pop("iteration")
        fields["checkpoints"] = tuple(CheckpointRecord.model_validate(item) for item in fields["checkpoints"])
        if status != "running":
            self.running.discard(trial_id)
        self.change(trial_id, status=status, node=result["node"], pid=result["pid"], **fields)
        self._scalars.write(self._records[trial_id], evaluated=evaluated)

    def on_step_end(self, iteration: int, trials: list[Trial], **info: Any) -> None:
        """Schedulers pause trials and tell no one; a paused trial has saved its checkpoint and needs no waiting for."""
        for trial in trials:
            trial_id = _trial_id(trial)
            if trial.status == Trial.PAUSED and trial_id in self.running:
                self.running.discard(trial_id)
                self.change(trial_id, status="paused")

    def on_trial_complete(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """Tune is done with the trial: its own end, the scheduler's decision, or the end of the run."""
        trial_id = _trial_id(trial)
        self.running.discard(trial_id)
        self._scalars.close(trial_id)
        if self._records[trial_id].status not in ("running", "paused"):
            return
        if self._store.stop_requested():
            self.change(trial_id, status="paused")
        else:
            steps = self._records[trial_id].num_env_steps
            self.change(
                trial_id,
                status="stopped",
                stop_reason=f"scheduler, at {steps} env steps",
                ended_at=time.time(),
            )

    def on_trial_recover(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """A failure that will be retried."""
        trial_id = _trial_id(trial)
        self.running.discard(trial_id)
        failures = self._records[trial_id].num_failures + 1
        self.change(trial_id, status="pending", num_failures=failures, error=self._error(trial))

    def on_trial_error(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """A failure that will not."""
        trial_id = _trial_id(trial)
        self.running.discard(trial_id)
        self._scalars.close(trial_id)
        failures = self._records[trial_id].num_failures + 1
        self.change(trial_id, status="failed", num_failures=failures, error=self._error(trial), ended_at=time.time())

    def _error(self, trial: Trial) -> str:
        # Trial.get_pickled_error looks where Tune syncs to, and nothing has been synced yet; this is where it writes.
        path = trial.pickled_error_file
        error = cloudpickle.loads(Path(path).read_bytes()) if path and Path(path).is_file() else None
        return describe_failure(error, self._store.trial(_trial_id(trial)).log_tail())

    def __getstate__(self) -> dict[str, Any]:
        # Tune pickles its callbacks into a file that is never read back here; listeners and open files can't be.
        return {}

    def close(self) -> None:
        """No event will come any more."""
        self._scalars.close_all()


def describe_failure(error: BaseException | None, log_tail: str) -> str:
    """What made a trial fail, in a line, and the end of its log."""
    if isinstance(error, RayTaskError):
        cause = error.cause if isinstance(error.cause, BaseException) else error
        message = str(cause) if isinstance(cause, TuneJobsError) else f"{type(cause).__name__}: {cause}"
    elif isinstance(error, RayActorError):
        message = "The process of the trial died"
        if "Timeout (" in log_tail:
            message += ": an iteration took longer than iteration_timeout_s"
        elif error.preempted:
            message += ": its node was taken away"
        message += "."
    else:
        message = str(error) if error is not None else "Unknown error."
    return f"{message}\n{log_tail}".strip()

"""Show a sweep that another process drives, here or on a cluster, from its records alone."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from analysis.records import SweepRecord, TrialRecord
from policies.arguments import checked
from policies.errors import CannotRunError, CheckpointError
from tune_jobs.process.interruption import EXIT_CODE as INTERRUPTED
from tune_jobs.ray_tune.jobs import Job
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.candidates import readable_trials, some_trials
from tune_jobs.store.command_names import name_in_commands
from tune_jobs.store.contract import Sweep
from tune_jobs.store.opening import resume_command
from tune_jobs.sweeps.current_best import has_current_best
from tune_jobs.sweeps.detached import failure_of, job_now, ran, why_not_asked
from tune_jobs.sweeps.forecast import caps_of
from tune_jobs.sweeps.live_view import shown
from tune_jobs.sweeps.monitor import SweepMonitor
from tune_jobs.sweeps.outcome import SweepResult, notes_on_best
from tune_jobs.sweeps.own_job import job_of
from tune_jobs.sweeps.reached import reached_of
from tune_jobs.sweeps.status import lacks_seeds

_POLL_S = 0.5
_ASK_EVERY_S = 5.0
_LET_GO_S = 10.0
"""How long a job may take to end after its driver has let go of the sweep; Ray looks once a second."""


@checked
def attach(sweep: str | Path, *, storage: str | Path | None = None, progress: str = "auto") -> SweepResult:
    """Show a sweep as the process that drives it would, until that process ends it; an interrupt only looks away.

    Args:
        sweep: Name or folder.
        storage: Folder for sweeps.
        progress: The same as for `tune_jobs.launch`.

    Returns:
        What came of it, as the records tell.

    Raises:
        NotFoundError: There is no such sweep.
        CannotRunError: Nothing runs it, and it is not done; or the process that ran it ended without saying so; or a
            job may run it, of a cluster that only the sweep's record names, and that would be shown Ray's token.
        SpecError: The job that was to run it found its arguments wrong.
    """
    from tune_jobs.sweeps.sources import find_sweep

    store = find_sweep(sweep, storage)
    job = _follow(store, progress)
    if not store.exists():
        raise CannotRunError(
            f"Sweep {store.name} was removed while it was shown, or its storage is gone: {store.place} has no record.",
            "List the others: `tune-jobs list`.",
        )
    record = store.read_record()
    go_on = resume_command(store, record)
    if record.job is not None and job is not None and job.has_ended and not ran(job):
        raise failure_of(store, record.job, job)
    if record.state in ("created", "running"):
        _refuse_if_not_asked(store, record)
    if record.state == "created":
        raise CannotRunError(f"Sweep {store.name} has not begun, and nothing runs it.", f"Run it with `{go_on}`.")
    if record.state == "running":
        raise CannotRunError(
            f"The process that ran sweep {store.name} has ended without finishing it.",
            f"What is done is kept; continue with `{go_on}`.",
        )
    return _result(store, record, job)


def _refuse_if_not_asked(store: Sweep, record: SweepRecord) -> None:
    """Refuse to say that nothing runs a sweep where a job may, of a cluster that is not asked.

    Raises:
        CannotRunError: Only the record names that cluster.
    """
    job = job_of(record, store.place)
    refused = None if job is None else why_not_asked(job)
    if refused is not None:
        raise refused.again(f"No process runs sweep {store.name} now. {refused.message}")


def _follow(store: Sweep, progress: str) -> Job | None:
    """Show a sweep until nothing drives it; return the job that did, if it can be asked."""
    look = _Look(store)
    if not look.goes_on():
        return look.job
    with tempfile.NamedTemporaryFile(prefix="tune-jobs-attach-") as log, shown(look.monitor, progress, Path(log.name)):
        while look.goes_on():
            look.update()
            time.sleep(_POLL_S)
        look.update()
    return look.job


class _Look:
    """A sweep as its records have it, looked at again and again."""

    def __init__(self, store: Sweep) -> None:
        self._store = store
        self._stamps: Mapping[str, object] = store.trial_stamps()
        record = store.read_record()
        trials = readable_trials(store)
        self.monitor = _Monitor(store.name, trials, caps=_caps(record, trials), reached=reached_of(store))
        # When a run began that goes on with an earlier one is not recorded.
        self.monitor.began_at = record.started_at if store.is_driven() and not record.run_time_s else None
        self.job: Job | None = None
        self._asked_at = -_ASK_EVERY_S
        self._let_go_at: float | None = None
        # Where a node was lost before this process looked, one has run too.
        self._has_run = record.address is not None and any(trial.node for trial in trials)

    def goes_on(self) -> bool:
        """Whether a process drives the sweep, or a job is about to."""
        now = time.monotonic()
        if self._store.is_driven():
            self._let_go_at = None
            return True
        job = job_of(self._store.read_record(), self._store.place) if self._store.exists() else None
        if job is None:
            return False
        if self._let_go_at is None:
            self._let_go_at = now
        # A job that waits may wait for long; one that has run is about to say how it ended.
        if now - self._asked_at >= (1.0 if now - self._let_go_at < _LET_GO_S else _ASK_EVERY_S):
            self.job, self._asked_at = job_now(job), now
        if self.job is None or self.job.has_ended:
            return False
        return self.job.status == "PENDING" or now - self._let_go_at < _LET_GO_S

    def update(self) -> None:
        """Read what has changed."""
        if not self._store.exists():
            return
        record, stamps = self._store.read_record(), self._store.trial_stamps()
        changed = [trial_id for trial_id, stamp in stamps.items() if self._stamps.get(trial_id) != stamp]
        self._stamps = stamps
        if any(trial_id not in self.monitor.records for trial_id in changed):
            trials = readable_trials(self._store)
            self.monitor.begin_stage("", trials, _caps(record, trials))
        else:
            for trial in some_trials(self._store, changed).values():
                # Of one that is damaged it is told in the end, and by `status`.
                if isinstance(trial, TrialRecord):
                    self.monitor.update(trial)
        self.monitor.phase = self._phase(record)

    def _phase(self, record: SweepRecord) -> str:
        if not self._store.is_driven():
            return "" if self.job is None else f"its job is {self.job.status.lower()}"
        if self._store.stop_requested():
            return "stopping: the running trials save a checkpoint"
        if record.state == "completed":
            return "confirming and filming the best policy, and writing the report"
        if record.waiting is not None:
            return f"waiting for {record.waiting.told(time.time())}"
        if record.state == "created" and record.job is not None:
            return "its job joins the cluster"
        if "running" in self.monitor.counts():
            self._has_run = True
        # Once a trial has run, the monitor says what the others wait for.
        return "" if self._has_run else "starting the trials"


class _Monitor(SweepMonitor):
    """Counts the time since the sweep began, if this is its first run, not since somebody looks."""

    began_at: float | None = None

    @property
    def elapsed_s(self) -> float:
        """Seconds since the sweep first began, or since it is shown."""
        return super().elapsed_s if self.began_at is None else max(0.0, time.time() - self.began_at)


def _caps(record: SweepRecord, trials: list[TrialRecord]) -> Mapping[str, int]:
    try:
        return caps_of(stored_spec(record), trials)
    except CheckpointError:
        # A sweep of another version is shown, too, without what is left of it.
        return {trial.trial_id: trial.num_env_steps for trial in trials}


def _result(store: Sweep, record: SweepRecord, job: Job | None) -> SweepResult:
    is_whole = record.state == "completed" and (job is None or job.driver_exit_code != INTERRUPTED)
    trials = readable_trials(store)
    best = store.read_best() if is_whole and has_current_best(store, trials) else None
    artifacts: dict[str, Path] = {}
    if best is not None:
        artifacts = {"policy": store.best_policy_path, **store.films()}
    page = store.current_report() if is_whole else None
    if page is not None:
        artifacts["report"] = page
    failed = is_whole and job is not None and job.driver_exit_code == 3
    return SweepResult(
        store.place,
        record,
        trials,
        best=best,
        why_no_best=_why_no_best(store, record, trials) if is_whole and best is None else None,
        artifacts=artifacts,
        interrupted=not is_whole,
        notes=notes_on_best(record, best),
        # Who leaves out what follows the trials has no report of them either.
        finish_failed=failed or (is_whole and best is None and page is not None),
    )


def _why_no_best(store: Sweep, record: SweepRecord, trials: Sequence[TrialRecord]) -> str:
    """Return why a sweep whose trials are done has no best policy, and what gives it one."""
    what = "the one there is was chosen before the sweep was trained on"
    if not store.has_best():
        what = "none was chosen"
        # Killed between the trials and what follows them: a choice now would be by one seed of each setting.
        if lacks_seeds(store, record, trials):
            why = "its leading settings got no more seeds (confirm), as nothing followed the trials"
            return f"{what}, and {why}: `{resume_command(store, record)}` does both"
    return f"{what}. `tune-jobs best {name_in_commands(store.place)}` does it, or says why not"

"""Driving a sweep whose lock is held: its records at the start, its trials, and what comes after them."""

from __future__ import annotations

import contextlib
import platform
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from analysis.records import FINISHED, BestRecord, SweepRecord, TrialRecord
from policies.errors import CannotRunError, EnvFailedError, TuneJobsError
from tune_jobs.address import check_address
from tune_jobs.machine import Machine
from tune_jobs.monitor import SweepMonitor
from tune_jobs.own_code import modules_of
from tune_jobs.ownership import OWNER_FILE, Owner
from tune_jobs.plan import SweepPlan, TrialPlan
from tune_jobs.spec import SweepSpec
from tune_jobs.spec_file import stored_spec
from tune_jobs.store import SweepStore

if TYPE_CHECKING:
    from tune_jobs.cluster import Connection

_PACKAGES = ("tune-jobs", "ray", "torch", "gymnasium", "numpy")


@dataclass(frozen=True)
class SweepResult:
    """What a launch, resume or extend left."""

    folder: Path
    sweep: SweepRecord
    trials: list[TrialRecord]
    best: BestRecord | None = None
    why_no_best: str | None = None
    artifacts: dict[str, Path] = field(default_factory=dict)
    """Where each result lies: policy, before_mp4, after_mp4, after_gif, before_after_mp4, report."""
    interrupted: bool = False
    notes: tuple[str, ...] = ()
    """What could not be made (a video of an environment that can't be drawn, say), and why."""
    finish_failed: bool = False
    """Whether no winner could be confirmed, or the environment failed where it was filmed."""

    @property
    def exit_code(self) -> int:
        """130 if it was interrupted, 3 if a trial failed or what comes after the trials did, else 0."""
        if self.interrupted:
            return 130
        return 3 if self.finish_failed or any(trial.status == "failed" for trial in self.trials) else 0


def write_new(store: SweepStore, spec: SweepSpec, plan: SweepPlan, address: str | None) -> None:
    """Write the records of a new sweep."""
    for trial in plan.trials:
        store.trial(trial.trial_id).write_record(pending_record(trial))
    # Last: a folder without it is no sweep, so nobody sees half of one.
    store.write_record(
        SweepRecord(
            name=store.name,
            state="running",
            spec=spec.model_copy(update={"name": store.name}).model_dump(mode="json"),
            evaluation_seeds=plan.evaluation_seeds,
            confirmation_seeds=plan.confirmation_seeds,
            num_trials=len(plan.trials),
            created_at=time.time(),
            versions=_versions(),
            git_commit=_git_commit(),
            address=address,
            allowed_modules=modules_of(spec),
        )
    )


def pending_record(trial: TrialPlan) -> TrialRecord:
    """The record of a trial that has not begun."""
    return TrialRecord(
        trial_id=trial.trial_id,
        index=trial.index,
        point_index=trial.point_index,
        seed_index=trial.seed_index,
        seed=trial.seed,
        point=trial.point,
        hyperparams=trial.hyperparams,
        has_point=trial.has_point,
        engine=trial.engine,
    )


def check_same_trials(store: SweepStore, plan: SweepPlan) -> None:
    """Check that planning again gives the trials that are there.

    Raises:
        CannotRunError: It does not; a resumed trial would train with other values than it began with.
    """
    planned = {trial.trial_id: trial for trial in plan.trials}
    for record in store.read_trials():
        trial = planned.get(record.trial_id)
        # A point that is not planned was chosen by the trials before it, which may be more by now.
        same = trial is not None and (not trial.has_point or trial.hyperparams == record.first_hyperparams)
        if trial is None or trial.seed != record.seed or not same:
            raise CannotRunError(
                f"Trial {record.trial_id} of sweep {store.name} is not the one its spec gives: sweep.json was changed, "
                "or was written by a version that draws other points.",
                "Restore sweep.json, or launch a new sweep.",
            )


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def _git_commit() -> str | None:
    """The commit of the working directory's repository, so that a sweep can be traced to a user's own code."""
    try:
        done = subprocess.run(
            ["git", "rev-parse", "HEAD"],  # noqa: S607 (git as the user has it)
            capture_output=True, text=True, timeout=5, check=False,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None if done.returncode == 0 else None


def connected(address: str | None, here: Machine | None) -> AbstractContextManager[Connection]:
    """Join a cluster or start Ray here; see `cluster.connect`. Imports ray only when it is called.

    Raises:
        SpecError: The address is none.
        CannotRunError: Nothing listens there.
    """
    if address is not None:
        check_address(address)
    from tune_jobs.cluster import connect

    return connect(address, here)


def run_sweep(
    store: SweepStore,
    plan: SweepPlan,
    *,
    address: str | None,
    machine: Machine | None,
    finish: bool,
    progress: str,
) -> SweepResult:
    """Run the unfinished trials of a sweep whose lock is held, then what comes after."""
    started = time.time()
    # From here on whatever an earlier run left, here or on other machines, can't take up a trial any more.
    run = Owner.take(store.folder / OWNER_FILE)
    store.clear_stop_request()
    record = store.read_record()
    store.write_record(
        record.model_copy(update={"state": "running", "started_at": record.started_at or started, "ended_at": None})
    )
    todo = tuple(trial.trial_id for trial in store.read_trials() if trial.status not in FINISHED)
    spec = stored_spec(record)
    monitor = SweepMonitor(
        store.name,
        store.read_trials(),
        max_env_steps_per_trial=spec.stop.num_env_steps,
        max_concurrent=plan.max_concurrent,
    )
    if todo:
        _run_trials(store, plan, todo, monitor, run, address=address, machine=machine, progress=progress)
    with run.held():
        interrupted = _close(store, started)
    from tune_jobs.candidates import read_trials

    records = read_trials(store)
    result = SweepResult(store.folder, store.read_record(), records, interrupted=interrupted)
    return result if interrupted or not finish else _finished(store, result)


def _run_trials(
    store: SweepStore,
    plan: SweepPlan,
    todo: tuple[str, ...],
    monitor: SweepMonitor,
    run: Owner,
    *,
    address: str | None,
    machine: Machine | None,
    progress: str,
) -> None:
    from tune_jobs.live import shown

    with shown(monitor, progress, store.driver_log, plan.notes), _stopping_on_signals(store, monitor):
        from tune_jobs.runner import RunJob, run_trials

        job = RunJob(
            store.folder,
            todo,
            plan.cpus_per_trial,
            plan.gpus_per_trial,
            plan.max_concurrent,
            packs=plan.packs,
            run=run.token,
        )
        # Signals are handled anew once Ray is joined: it sets a handler of its own for SIGTERM, which ends the process.
        with (
            contextlib.suppress(KeyboardInterrupt),
            connected(address, machine) as connection,
            _stopping_on_signals(store, monitor),
        ):
            if connection.is_client:
                from tune_jobs.remote_driver import run_trials_remotely

                run_trials_remotely(job, monitor.update)
            else:
                run_trials(job, monitor.update)


def _close(store: SweepStore, started: float) -> bool:
    """Write down how the run ended; returns whether it was interrupted."""
    interrupted = False
    for trial in store.read_trials():
        if trial.status not in FINISHED:
            interrupted = True
            if trial.status == "running":
                store.trial(trial.trial_id).write_record(trial.model_copy(update={"status": "paused"}))
    record = store.read_record()
    now = time.time()
    store.write_record(
        record.model_copy(
            update={
                "state": "interrupted" if interrupted else "completed",
                "ended_at": now,
                "run_time_s": record.run_time_s + now - started,
            }
        )
    )
    store.clear_stop_request()
    return interrupted


def _finished(store: SweepStore, result: SweepResult) -> SweepResult:
    """Choose, confirm and film the winner, and write the report; what can't be made is noted, not raised."""
    from tune_jobs import finish

    chosen: BestRecord | None = None
    why: TuneJobsError | None = None
    notes: list[str] = []
    artifacts: dict[str, Path] = {}
    try:
        chosen = finish.choose_best(store)
        artifacts["policy"] = store.best_folder / "policy.json"
    except TuneJobsError as error:
        why = error
    failed = why is not None

    def attempt(what: str, make: Callable[[], dict[str, Path]]) -> bool:
        """Whether it went well, or could not have: not every environment can be drawn."""
        try:
            artifacts.update(make())
        except TuneJobsError as error:
            notes.append(f"No {what}: {error}")
            return not isinstance(error, EnvFailedError)
        return True

    if chosen is not None:
        failed |= not attempt("video", lambda: finish.make_videos(store))
    attempt("report", lambda: {"report": finish.make_report(store, why)})
    return replace(
        result,
        best=chosen,
        why_no_best=None if why is None else str(why),
        artifacts=artifacts,
        notes=tuple(notes),
        finish_failed=failed,
    )


@contextlib.contextmanager
def _stopping_on_signals(store: SweepStore, monitor: SweepMonitor) -> Iterator[None]:
    """Let the first Ctrl-C (or SIGTERM) ask the trials to save and stop, and the second end them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def ask(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 (the signature of a handler)
        if monitor.stopping:
            raise KeyboardInterrupt
        monitor.stopping = True
        store.request_stop()

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

"""Drive a sweep whose lock is held: write its records, run its trials, and conclude it."""

from __future__ import annotations

import contextlib
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis.records import FINISHED, BestRecord, SweepRecord, SweepState
from policies.errors import CannotRunError, EnvFailedError, TuneJobsError
from tune_jobs.plan.machine import Machine, local_machine
from tune_jobs.plan.sweep_plan import SweepPlan
from tune_jobs.plan.user_code import modules_of
from tune_jobs.process.interruption import current
from tune_jobs.ray_tune.address import check_address
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.closing import close_run
from tune_jobs.store.contract import Ownership, Sweep
from tune_jobs.store.ownership import OwnershipLostError
from tune_jobs.store.transitions import pending_record
from tune_jobs.sweeps.forecast import caps_of
from tune_jobs.sweeps.monitor import SweepMonitor
from tune_jobs.sweeps.outcome import SweepResult

if TYPE_CHECKING:
    from tune_jobs.ray_tune.cluster import Connection

_PACKAGES = ("tune-jobs", "ray", "torch", "gymnasium", "numpy")


def write_new(
    store: Sweep, spec: SweepSpec, plan: SweepPlan, address: str | None, state: SweepState = "running"
) -> None:
    """Write the records of a new sweep, which is run at once or only created."""
    for trial in plan.trials:
        store.trial(trial.trial_id).write_record(pending_record(trial))
    # Written last: a folder without this record is not a sweep, so no reader sees half of one.
    store.write_record(
        SweepRecord(
            name=store.name,
            state=state,
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


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def _git_commit() -> str | None:
    """Return the commit of the working directory's repository, which tells the version of a user's own code."""
    try:
        done = subprocess.run(
            ["git", "rev-parse", "HEAD"],  # noqa: S607 (the user's git)
            capture_output=True, text=True, timeout=5, check=False,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None if done.returncode == 0 else None


def connected(address: str | None, here: Machine | None) -> AbstractContextManager[Connection]:
    """Join a cluster or start Ray here; see `cluster.connect`. Ray is imported only when this is called.

    Raises:
        SpecError: The address has a wrong form.
        CannotRunError: Nothing listens there.
    """
    if address is not None:
        check_address(address)
    from tune_jobs.ray_tune.cluster import connect

    return connect(address, here)


def machine_here() -> Machine:
    """Return where a sweep without an address runs: the Ray that the user joined in this process, or this machine."""
    if not _is_connected_by_user():
        return local_machine()
    from tune_jobs.ray_tune.connected_ray import connected_machine

    return connected_machine()


def address_of_users_ray() -> str | None:
    """Return the address of the Ray that the user joined in this process; None: there is none, or it is a sweep's."""
    if not _is_connected_by_user():
        return None
    from tune_jobs.ray_tune.connected_ray import address_for_others

    return address_for_others()


def _is_connected_by_user() -> bool:
    ray: Any = sys.modules.get("ray")
    # While another thread imports ray, it has no such function yet.
    if ray is None or not getattr(ray, "is_initialized", bool)():
        return False
    from tune_jobs.ray_tune.connected_ray import is_of_a_sweep

    return not is_of_a_sweep()


@contextlib.contextmanager
def settled(store: Sweep) -> Iterator[None]:
    """Ensure that the sweep's record does not say running after the block; its lock has to be held."""
    is_ours = True
    try:
        yield
    except OwnershipLostError:
        is_ours = False
        raise
    finally:
        # If it cannot be read or written here, this was so before too, and that error is reported.
        with current().shielded(), contextlib.suppress(TuneJobsError):
            if is_ours and store.exists():
                store.clear_stop_request()
                store.remove_leftovers()
                _close_if_open(store)


def run_sweep(
    store: Sweep,
    plan: SweepPlan,
    *,
    address: str | None,
    machine: Machine | None,
    finish: bool,
    progress: str,
) -> SweepResult:
    """Run the unfinished trials of a sweep whose lock is held, then conclude it.

    A KeyboardInterrupt ends it with the results so far: the records are written, whatever was begun.
    """
    try:
        return _run_sweep(store, plan, address=address, machine=machine, finish=finish, progress=progress)
    except KeyboardInterrupt:
        with current().shielded():
            current().came = True
            _close_if_open(store)
            return SweepResult(store.folder, store.read_record(), store.read_trials(), interrupted=True)


def _run_sweep(
    store: Sweep,
    plan: SweepPlan,
    *,
    address: str | None,
    machine: Machine | None,
    finish: bool,
    progress: str,
) -> SweepResult:
    # From here on, processes that an earlier run left, here or on other machines, can't take a trial any more.
    run = store.take()
    todo = tuple(trial.trial_id for trial in store.read_trials() if trial.status not in FINISHED)
    if todo:
        if current().came:
            # The signal came while the records were written, which is never cut short.
            raise KeyboardInterrupt
        record = store.read_record()
        started = record.started_at or time.time()
        store.write_record(record.model_copy(update={"state": "running", "started_at": started, "ended_at": None}))
        spec, trials = stored_spec(record), store.read_trials()
        monitor = SweepMonitor(
            store.name,
            trials,
            caps=caps_of(spec, trials),
            max_concurrent=plan.max_concurrent,
        )
        try:
            _run_trials(store, plan, todo, monitor, run, address=address, machine=machine, progress=progress)
        finally:
            run.release()
        _close_if_open(store)
    from tune_jobs.store.candidates import read_trials

    records = read_trials(store)
    interrupted = any(trial.status not in FINISHED for trial in records)
    result = SweepResult(store.folder, store.read_record(), records, interrupted=interrupted)
    if interrupted or not finish:
        return result
    return replace(result, interrupted=True) if current().came else _finished(store, result, progress, keep=not todo)


def _run_trials(
    store: Sweep,
    plan: SweepPlan,
    todo: tuple[str, ...],
    monitor: SweepMonitor,
    run: Ownership,
    *,
    address: str | None,
    machine: Machine | None,
    progress: str,
) -> None:
    from tune_jobs.sweeps.live_view import shown

    def ask() -> None:
        monitor.stopping = True
        store.request_stop()

    started = time.time()
    monitor.phase = "starting Ray" if address is None else f"joining the Ray cluster at {address}"
    with _noted(), shown(monitor, progress, store.driver_log, plan.notes):
        from tune_jobs.ray_tune.run_trials import RunJob, run_trials

        job = RunJob(
            store.folder,
            todo,
            plan.cpus_per_trial,
            plan.gpus_per_trial,
            plan.max_concurrent,
            packs=plan.packs,
            run=run.token,
        )
        with current().asking(ask), connected(address, machine) as connection:
            monitor.phase = "starting the trials"
            try:
                if connection.is_client:
                    from tune_jobs.ray_tune.driver_actor import run_trials_remotely

                    run_trials_remotely(job, monitor.update)
                else:
                    run_trials(job, monitor.update)
            except CannotRunError:
                # A signal to the whole process group ends Ray's processes too, which is not a failure of Ray.
                if not current().came:
                    raise
            finally:
                monitor.phase = "ending Ray" if address is None else "leaving the Ray cluster"
                # Done before Ray is shut down: if a part of Ray died, that takes long, and may end this process.
                with current().shielded(), run.held():
                    close_run(store, started)


@contextlib.contextmanager
def _noted() -> Iterator[None]:
    """End the block at a KeyboardInterrupt, which is raised again when everything is saved."""
    try:
        yield
    except KeyboardInterrupt:
        current().came = True


def _close_if_open(store: Sweep) -> None:
    """Close the run if Ray failed before the run began."""
    with current().shielded():
        if store.read_record().state == "running":
            close_run(store)


def _finished(store: Sweep, result: SweepResult, progress: str = "none", *, keep: bool = False) -> SweepResult:
    """Choose, confirm and film the winner, and write the report; what can't be made is noted, and raises no error.

    Args:
        store: The sweep.
        result: The trials.
        progress: Whether it is told what is done, as for `launch`.
        keep: Whether only what is missing or out of date is made: the records of a sweep that was finished before stay
            as they are, whichever machine, version or number of episodes they came from.
    """
    made = _Finish(store, progress, keep=keep)
    with _noted():
        made.make_all()
    return replace(
        result,
        best=made.best,
        why_no_best=made.why_no_best,
        finish_failed=made.failed,
        artifacts=made.artifacts,
        notes=tuple(made.notes),
        interrupted=made.stopped or current().came,
    )


class _Finish:
    """Makes what comes after the trials, as far as possible."""

    def __init__(self, store: Sweep, progress: str, *, keep: bool) -> None:
        self._store = store
        self._progress = progress
        self._keep = keep
        self.best: BestRecord | None = None
        self._why: TuneJobsError | None = None
        self.artifacts: dict[str, Path] = {}
        self.notes: list[str] = []
        self.stopped = False
        """Whether another process asked to stop before everything was made."""
        self.failed = False
        """Whether no winner could be confirmed, or the environment failed where it was filmed."""

    @property
    def why_no_best(self) -> str | None:
        """Why no winner could be chosen."""
        return None if self._why is None else str(self._why)

    def make_all(self) -> None:
        """Make everything that can be made."""
        from tune_jobs.store.candidates import confirmed_best
        from tune_jobs.sweeps import conclude as finish
        from tune_jobs.sweeps.settings import with_present_settings

        store = self._store
        if self._keep:
            self.best = confirmed_best(store)
        kept = self.best is not None
        try:
            if self.best is not None:
                self.best = with_present_settings(store, self.best)
            else:
                with self._working("confirming the best policy"):
                    self.best = finish.choose_best(store)
            self.artifacts["policy"] = store.best_policy_path
        except TuneJobsError as error:
            self._why = error
        self.failed = self._why is not None
        if self.best is not None:
            films = dict(store.current_films()) if kept else {}
            self.artifacts.update(films)
            if not films:
                self._attempt("video", "filming the best policy", lambda: finish.make_videos(store))
        page = store.current_report() if kept else None
        if page is not None:
            self.artifacts["report"] = page
        else:
            self._attempt("report", "writing the report", lambda: {"report": finish.make_report(store, self._why)})

    def _working(self, doing: str) -> AbstractContextManager[None]:
        from tune_jobs.sweeps.live_view import working

        return working(self._store.name, doing, self._progress)

    def _attempt(self, what: str, doing: str, make: Callable[[], dict[str, Path]]) -> None:
        # Another process may have asked to stop, which ends this too.
        self.stopped = self.stopped or self._store.stop_requested()
        if self.stopped:
            return
        try:
            with self._working(doing):
                self.artifacts.update(make())
        except TuneJobsError as error:
            self.notes.append(f"No {what}: {error}")
            # Other errors are expected, as not every environment can be drawn.
            self.failed = self.failed or isinstance(error, EnvFailedError)

"""Run the queue: start a driver for each job that may run, watch those that run, and find them again after a restart.

Nothing here is believed because it was remembered: whether a driver lives is asked of the job's lock, and how it ended
of the job's file. So a service that was killed, and began anew, does the same as one that was not.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from sqlalchemy.exc import SQLAlchemyError

from policies.errors import TuneJobsError, fit
from tune_jobs.service.draining import Draining
from tune_jobs.service.ending import join, within
from tune_jobs.service.job_files import JobFiles, held_jobs, remove_ended
from tune_jobs.service.jobs import Job, Outcome
from tune_jobs.service.outages import Outages
from tune_jobs.service.queue import Queue
from tune_jobs.service.spare import Driver, memory_of_tree
from tune_jobs.service.storage_health import is_of_store
from tune_jobs.service.surroundings import Surroundings
from tune_jobs.store.contract import Storage, Sweep
from tune_jobs.store.half_made import free_half_made

_log = logging.getLogger(__name__)

TICK_S = 0.25
MAX_ATTEMPTS = 5
"""How many driver processes of one job may die, one after the other, before it counts as failed."""
_LOOKING = "The queue can't be looked at"


class Supervisor:
    """The thread that runs the queue.

    Args:
        queue: The jobs.
        storage: The sweeps.
        where: Where they run.
        spare_idle_s: How long a driver process is kept warm while no sweep comes, in seconds; 0: not at all.
        on_end: Called with each job that has ended; after a kill perhaps again.
        on_death: Called when a driver has died before its job had ended.
        make_driver: Starts a driver process.
        outages: Where it is noted that the queue can't be looked at.
        settle: Called before each look at the queue, to tell it what it could not be told before; if it raises, there
            is no look.
    """

    def __init__(
        self,
        queue: Queue,
        storage: Storage,
        where: Surroundings,
        *,
        spare_idle_s: float = 1_800.0,
        on_end: Callable[[Job], None] = lambda _: None,
        on_death: Callable[[], None] = lambda: None,
        make_driver: Callable[[Mapping[str, Any]], Driver] = Driver,
        outages: Outages | None = None,
        settle: Callable[[], None] = lambda: None,
    ) -> None:
        self._queue, self._storage, self._where = queue, storage, where
        self._spare_idle_s, self._on_end, self._on_death = spare_idle_s, on_end, on_death
        self._make_driver, self._settle = make_driver, settle
        self._outages = Outages() if outages is None else outages
        self._idle_since = time.monotonic()
        self._spare: Driver | None = None
        self._children: dict[int, Driver] = {}
        self._retry_at: dict[int, float] = {}
        self._not_started: dict[int, str] = {}
        self._wake, self._end = threading.Event(), threading.Event()
        self._draining = threading.Event()
        self._thread = threading.Thread(target=self._run, name="queue", daemon=True)

    # -- from other threads

    def start(self) -> None:
        """Find what ran before, and begin."""
        self.reconcile()
        self._thread.start()

    def wake(self) -> None:
        """Look at the queue now."""
        self._wake.set()

    def drain(self, timeout_s: float) -> bool:
        """Start nothing more, let running sweeps save and their jobs wait again, and end.

        Returns:
            Whether all have saved in that time. Those that have not run on, and are found again.
        """
        self._draining.set()
        self.wake()
        draining, deadline = Draining(self._where.service_folder), time.monotonic() + timeout_s
        while (is_left := self._is_left(draining)) and time.monotonic() < deadline:
            time.sleep(TICK_S)
        self.close()
        return not is_left

    def _is_left(self, draining: Draining) -> bool:
        """Whether a driver has not saved yet, or the queue doesn't have its job among those that wait again."""
        if draining.ask():
            return True
        try:
            return bool(within(lambda: self._queue.jobs("running")))
        except (SQLAlchemyError, TuneJobsError) as error:
            # What saved is in the jobs' files, too, which the next start looks at.
            self._outages.failed(_LOOKING, error)
            return False

    def close(self) -> None:
        """End the thread; drivers live on."""
        self._end.set()
        self.wake()
        join(self._thread)
        spare, self._spare = self._spare, None
        if spare is not None:
            spare.dismiss()

    @property
    def is_alive(self) -> bool:
        """Whether the queue is being run."""
        return self._thread.is_alive()

    @property
    def is_draining(self) -> bool:
        """Whether it starts nothing more."""
        return self._draining.is_set()

    def spare(self) -> dict[str, Any] | None:
        """Return whether the process that is kept for the next sweep is warm, and its memory; None: there is none."""
        spare = self._spare
        if spare is None:
            return None
        return {"warm": spare.is_usable() and spare.is_warm(), "memory_bytes": memory_of_tree(spare.pid)}

    def spare_is_warm(self) -> bool | None:
        """Whether the process that is kept for the next sweep is warm; None: there is none."""
        spare = self._spare
        return None if spare is None else spare.is_usable() and spare.is_warm()

    def num_drivers(self) -> int:
        """Return how many processes drive sweeps now, as the locks of running jobs say."""
        return sum(self._files(job).is_run() for job in self._queue.jobs("running"))

    @property
    def where(self) -> Surroundings:
        """Where jobs run."""
        return self._where

    # -- the queue

    def reconcile(self) -> None:
        """Make queue and folders agree, after a start: folders are the truth.

        A job whose sweep was never written is forgotten, and what there is of that removed. Sweeps that were written
        but not begun, or whose driver was killed, and that have no job, get one: the database was lost, or they were
        made by somebody else's hands. Those whose job was stopped, or failed, wait for somebody who resumes them.
        """
        open_jobs = self._queue.jobs("creating", "waiting", "running")
        for job in open_jobs:
            if job.state != "creating":
                continue
            if self._storage.sweep(job.sweep).exists():
                self._queue.created(job.id, num_cpus=self._where.unplanned_cpus)
            else:
                free_half_made(self._storage, job.sweep)
                self._queue.forget(job.id)
        known = {job.sweep for job in open_jobs}
        ours = {holder.sweep for holder in held_jobs(self._where.service_folder)}
        last = {job.sweep: job for job in self._queue.jobs("ended")}
        for sweep in self._storage.sweeps():
            if sweep.name in known:
                continue
            try:
                if sweep.is_driven() and sweep.name not in ours:
                    continue
                record = sweep.read_record()
                if record.state in ("created", "running") and not _is_over(last.get(sweep.name), record.created_at):
                    self._queue.begin(sweep.name, "drive", {}, owner="", num_cpus=self._where.unplanned_cpus)
            except TuneJobsError as error:
                if is_of_store(self._storage, error):
                    raise
                # A folder's name may be no text.
                name = fit(sweep.name)
                _log.warning("Sweep %s is left alone: %s", name, error, extra={"sweep": name})
        self._remove_files()

    def _run(self) -> None:
        while not self._end.is_set():
            try:
                self._look()
                self._outages.worked(_LOOKING)
            except Exception as error:  # noqa: BLE001 (whatever it is, the queue has to go on)
                # Such as a database that is away for a while: it is tried again, and the service says that it is so.
                self._outages.failed(_LOOKING, error)
                self._end.wait(1.0)
            self._wake.wait(TICK_S)
            self._wake.clear()

    def _look(self) -> None:
        was_over = self._end.is_set()
        self._settle()
        for pid in [pid for pid, child in self._children.items() if child.poll() is not None]:
            del self._children[pid]
        for job in self._queue.jobs("running"):
            if self._end.is_set() != was_over:
                return  # the database was silent for long: another service may have it by now
            with self._apart(job.sweep):
                self._look_at(job)
        may_run = functools.cache(self._may_run)
        while self._end.is_set() == was_over and not self._draining.is_set():
            claimed = self._queue.claim(self._where.num_cpus, may_run)
            if claimed is None:
                break
            self._start(claimed)
        self._mind_spare()

    def _may_run(self, name: str) -> bool:
        """Whether nobody else drives a sweep, such as a person with a terminal; one of which that isn't known waits."""
        with self._apart(name):
            return not self._sweep(name).is_driven()
        return False

    @contextlib.contextmanager
    def _apart(self, name: str) -> Iterator[None]:
        """Let what is wrong with one sweep, such as a lock that can't be read, keep no other one from running."""
        what = f"Sweep {name} can't be looked at"
        try:
            yield
        except TuneJobsError as error:
            if is_of_store(self._storage, error):
                raise
            self._outages.failed(what, error)
        else:
            self._outages.worked(what)

    def _look_at(self, job: Job) -> None:
        files = self._files(job)
        if files.is_run():
            if job.stop_requested:
                # Again and again: the driver may not have begun to listen.
                sweep = self._sweep(job.sweep)
                if sweep.is_driven() and not sweep.stop_requested():
                    sweep.request_stop()
            return
        ended = files.read_ended(job.num_attempts)
        if ended is not None and ended.outcome != "interrupted":
            self._finish(job, ended.outcome, ended.message, finish_failed=ended.finish_failed)
        elif job.stop_requested:
            self._finish(job, "stopped")
        elif ended is not None or self._draining.is_set():
            # Whoever wants the end of the sweep, and not of the process, asks for it: it goes on later.
            self._queue.give_back(job.id)
        else:
            self._died(job, files)

    def _died(self, job: Job, files: JobFiles) -> None:
        """Let another driver go on, after a while, or give up."""
        num_deaths = files.num_deaths(job.num_attempts)
        if num_deaths >= MAX_ATTEMPTS:
            said, why = files.last_lines(), self._not_started.get(job.id)
            message = f"The process that ran the sweep died {num_deaths} times."
            if why is not None:
                message = f"The sweep can't be started, after {num_deaths} attempts: {why}"
            self._finish(job, "failed", message + (f"\n{said}" if said else ""))
            self._on_death()
        elif self._retry_at.setdefault(job.id, time.monotonic() + _wait_s(num_deaths)) <= time.monotonic():
            # First of all: where the queue can't be written, nothing goes on, and it is tried again at each look.
            again = self._queue.again(job.id)
            del self._retry_at[job.id]
            self._on_death()
            _log.warning(
                "The driver of job %d (sweep %s) died; another one goes on.", job.id, job.sweep, extra=job.log_fields
            )
            self._start(again)

    def _finish(
        self, job: Job, outcome: Outcome, message: str | None = None, *, finish_failed: bool | None = None
    ) -> None:
        # What processes print may have characters that no database takes.
        message = None if message is None else fit(message)
        # First it is told: whoever is killed in between tells it twice, and not never.
        now = time.time()
        said = {"outcome": outcome, "message": message, "finish_failed": finish_failed}
        self._on_end(job.model_copy(update=said | {"state": "ended", "ended_at": now}))
        self._queue.end(job.id, outcome, message, at=now, finish_failed=finish_failed)
        _log.info("Job %d (%s of sweep %s) has ended: %s.", job.id, job.verb, job.sweep, outcome, extra=job.log_fields)
        self._not_started.pop(job.id, None)
        # All that they said is in the queue now.
        if outcome != "failed":
            self._files(job).remove()
        self._remove_files()

    def _remove_files(self) -> None:
        """Remove the files of jobs that have ended."""
        open_uids = {job.uid for job in self._queue.jobs("creating", "waiting", "running")}
        remove_ended(self._where.service_folder, open_uids, time.time())

    def _start(self, job: Job) -> None:
        try:
            self._give(job, self._files(job))
            self._not_started.pop(job.id, None)
        except (TuneJobsError, OSError) as error:
            # It is looked at again, as one whose driver died; other jobs and the queue have nothing to do with it.
            self._not_started[job.id] = str(error)
            _log.warning("Job %d can't be started: %s", job.id, error, extra=job.log_fields)

    def _give(self, job: Job, files: JobFiles) -> None:
        """Give a job to a driver."""
        lock = files.take()
        if lock is None:
            # A driver of an earlier life of the service runs it: it is watched like any other.
            return
        try:
            driver = self._driver()
            request = {
                "service": str(self._where.service_folder),
                "job": job.uid,
                "number": job.id,
                "attempt": job.num_attempts,
                "started_at": job.started_at,
                "sweep": self._sweep(job.sweep).place,
                "verb": job.verb,
                "arguments": job.arguments,
                "address": self._where.address,
                "num_cpus": job.num_cpus,
                "wait_for_nodes": job.arguments.get("wait_for_nodes", self._where.wait_for_nodes),
            }
            try:
                driver.give(request, lock, files.log)
            except BaseException:
                # It has no job, and waits for one: the next attempt takes it, if it lives.
                self._spare = driver
                raise
            self._children[driver.pid] = driver
            told = (job.id, job.verb, job.sweep, driver.pid)
            _log.info("Job %d (%s of sweep %s) is run by process %d.", *told, extra=job.log_fields)
        finally:
            os.close(lock)

    def _driver(self) -> Driver:
        spare, self._spare = self._spare, None
        if spare is not None and spare.is_usable():
            return spare
        return self._make_driver(self._settings(warm=False))

    def _settings(self, *, warm: bool) -> dict[str, Any]:
        return {
            "modules": self._where.modules,
            "log_format": self._where.log_format,
            "working_folder": str(self._where.working_folder),
            # A cluster has its own.
            "warm_ray": warm and self._where.address is None,
        }

    def _mind_spare(self) -> None:
        if self._draining.is_set():
            return
        if self._spare is not None and not self._spare.is_usable():
            self._spare = None
        if self._queue.jobs("running"):
            # The next one waits for them; importing would only take their time.
            self._idle_since = time.monotonic()
        elif time.monotonic() - self._idle_since >= self._spare_idle_s:
            if self._spare is not None:
                _log.info("No sweep came for %g s: what was kept warm for one ends.", self._spare_idle_s)
                spare, self._spare = self._spare, None
                spare.dismiss()
        elif self._spare is None:
            with contextlib.suppress(TuneJobsError):
                self._spare = self._make_driver(self._settings(warm=True))

    def _files(self, job: Job) -> JobFiles:
        return JobFiles(self._where.service_folder, job.uid)

    def _sweep(self, name: str) -> Sweep:
        return self._storage.sweep(name)


def _is_over(job: Job | None, created_at: float) -> bool:
    """Whether a sweep stays as the last of its jobs left it, which somebody stopped or which failed.

    A job that ended before the sweep was created was another's of the same name.
    """
    return job is not None and job.outcome in ("stopped", "cancelled", "failed") and not job.is_of_former(created_at)


def _wait_s(num_deaths: int) -> float:
    """Return how long to wait before the next attempt: what killed the last one may still be there."""
    return min(30.0, 0.5 * 2.0 ** (num_deaths - 1))

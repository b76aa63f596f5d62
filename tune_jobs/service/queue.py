"""The queue: which jobs wait, run and have ended. Only this module changes the table of jobs.

A job's state moves creating -> waiting -> running -> ended; a running one goes back to waiting when the service is
drained. Each change is one transaction, so a service that is killed leaves either the former state or the next one.
"""

from __future__ import annotations

import math
import time
import uuid
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Engine, Row, RowMapping, delete, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from policies.errors import NotFoundError, SpecError, fit
from tune_jobs.service.database.tables import jobs, submissions
from tune_jobs.service.folder_names import check_for_job
from tune_jobs.service.jobs import Job, JobState, Outcome, Verb


class KeyUsedError(SpecError):
    """An idempotency key was used for another request."""


@dataclass(frozen=True)
class Load:
    """How much there is to do."""

    counts: Mapping[tuple[JobState, Verb], int]
    """The jobs that have not ended, by state and verb; those that there are none of are left out."""
    num_cpus: float
    """CPUs that running jobs take."""
    num_owners: int
    """How many people's jobs have not ended."""
    waited_s: float
    """How long the job that waits the longest has waited, in seconds; 0: none waits."""


class Queue:
    """Jobs in a database.

    Args:
        engine: The database.
        now: Returns seconds since 1970.
    """

    def __init__(self, engine: Engine, now: Any = time.time) -> None:
        self._engine = engine
        self._now = now

    # -- coming in

    def begin(
        self,
        sweep: str,
        verb: Verb,
        arguments: Mapping[str, Any],
        *,
        owner: str,
        priority: int = 0,
        num_cpus: float = 0.0,
        key: tuple[str, str] | None = None,
        state: JobState = "waiting",
    ) -> tuple[Job, bool]:
        """Add a job, unless a request with the same key has.

        Args:
            sweep: Name of the sweep.
            verb: What is to be done.
            arguments: What the verb needs.
            owner: Who asks.
            priority: Higher ones go first.
            num_cpus: CPUs that it takes.
            key: Idempotency key and the digest of the request; None: the request has no key.
            state: `creating` for a sweep that is not written yet.

        Returns:
            The job, and whether it is new.

        Raises:
            KeyUsedError: The owner used the key for another request.
            CheckpointError: The sweep's name is none that a job can have.
        """
        check_for_job(sweep)
        row = {
            "uid": uuid.uuid4().hex, "sweep": sweep, "verb": verb, "arguments": dict(arguments), "owner": owner,
            "priority": priority, "num_cpus": num_cpus, "state": state, "num_attempts": 0, "stop_requested": False,
            "submitted_at": self._now(),
        }  # fmt: skip
        try:
            with self._engine.begin() as connection:
                if key is not None and (same := self._known(connection, owner, *key)) is not None:
                    return same, False
                job_id = connection.execute(insert(jobs).values(row).returning(jobs.c.id)).scalar_one()
                if key is not None:
                    values = {"owner": owner, "key": key[0], "digest": key[1], "job_id": job_id}
                    connection.execute(insert(submissions).values(values | {"created_at": self._now()}))
                return _job(connection, job_id), True
        except IntegrityError:
            # Two requests with one key came at once; in PostgreSQL both may look before one of them writes.
            if key is None:
                raise
            with self._engine.begin() as connection:
                known = self._known(connection, owner, *key)
            if known is None:
                raise
            return known, False

    def known(self, owner: str, key: str, digest: str) -> Job | None:
        """Return the job that an earlier request with this key made; None: there was none.

        Raises:
            KeyUsedError: The owner used the key for another request.
        """
        with self._engine.begin() as connection:
            return self._known(connection, owner, key, digest)

    def _known(self, connection: Connection, owner: str, key: str, digest: str) -> Job | None:
        found = connection.execute(
            select(submissions.c.digest, submissions.c.job_id).where(
                submissions.c.owner == owner, submissions.c.key == key
            )
        ).first()
        if found is None:
            return None
        if found.digest != digest:
            raise KeyUsedError(
                f"The idempotency key {key!r} was used for another request.", "Give each new request a key of its own."
            )
        return _job(connection, found.job_id)

    def created(self, job_id: int, *, num_cpus: float) -> Job:
        """Let a job wait, as its sweep is written."""
        return self._change(job_id, {"state": "waiting", "num_cpus": num_cpus}, ("creating",))

    def forget(self, job_id: int) -> None:
        """Remove a job whose sweep could not be written, and its key: the request may be sent again."""
        with self._engine.begin() as connection:
            connection.execute(delete(submissions).where(submissions.c.job_id == job_id))
            connection.execute(delete(jobs).where(jobs.c.id == job_id, jobs.c.state == "creating"))

    def rename(self, job_id: int, sweep: str) -> Job:
        """Name the sweep of a job that is being created, as the name that was chosen is taken by now."""
        return self._change(job_id, {"sweep": sweep}, ("creating",))

    # -- to be run

    def claim(self, num_cpus: float, may_run: Any = None) -> Job | None:
        """Take the next job to run.

        The highest priority goes first; among owners, the one with the fewest running jobs, then the one whose last job
        started the longest ago. A job that is next but does not fit is waited for: smaller ones behind it would keep it
        from ever running. With nothing running, everything fits. Jobs of one sweep run one after the other.

        Args:
            num_cpus: CPUs that there are.
            may_run: Says of a sweep's name whether it may run now, such as that nobody else drives it; None: all may.
                It is asked of no more sweeps than it takes to find the next one, and of none where none fits.
        """
        free: str | None = None
        if may_run is not None:
            # Before the queue is locked, as a store elsewhere may have to be watched for some seconds.
            free = next(filter(may_run, self._names_in_order(num_cpus)), None)
            if free is None:
                return None
        with self._engine.begin() as connection:
            # Whoever claims at the same time waits here, and sees what this one took (SQLite has one writer). All
            # lock in one order, so that no two wait for each other.
            waiting, running = _open_jobs(connection, _OPEN.with_for_update())
            waiting = [job for job in waiting if free is None or job.sweep == free]
            if not waiting:
                return None
            job = _in_order(connection, waiting, running)[0]
            if not _fits(job, running, num_cpus):
                return None
            values = {
                "state": "running", "started_at": job.started_at or self._now(), "num_attempts": job.num_attempts + 1,
            }  # fmt: skip
            connection.execute(update(jobs).where(jobs.c.id == job.id, jobs.c.state == "waiting").values(values))
            return _job(connection, job.id)

    def _names_in_order(self, num_cpus: float) -> list[str]:
        """Return the sweeps of the jobs that may be next, the first one first; none where no job fits."""
        with self._engine.begin() as connection:
            waiting, running = _open_jobs(connection, _OPEN)
            smallest = min(waiting, key=_cpus_of, default=None)
            if smallest is None or not _fits(smallest, running, num_cpus):
                return []
            return [job.sweep for job in _in_order(connection, waiting, running)]

    def again(self, job_id: int) -> Job:
        """Note that a running job gets another driver process, as the last one died."""
        return self._change(job_id, {"num_attempts": jobs.c.num_attempts + 1}, ("running",))

    def give_back(self, job_id: int) -> Job:
        """Let a running job wait again, as the service is drained."""
        return self._change(job_id, {"state": "waiting", "stop_requested": False}, ("running",))

    def end(
        self,
        job_id: int,
        outcome: Outcome,
        message: str | None = None,
        *,
        finish_failed: bool | None = None,
        at: float | None = None,
    ) -> Job:
        """End a job that waits or runs.

        Args:
            job_id: The job.
            outcome: How it ended.
            message: Why it failed, or what is to be said of what it did.
            finish_failed: Whether what follows the trials failed; None: they did not come to their end.
            at: When, in seconds since 1970; None: now.
        """
        values = {
            "state": "ended", "outcome": outcome, "message": None if message is None else fit(message),
            "finish_failed": finish_failed, "ended_at": self._now() if at is None else at,
        }  # fmt: skip
        return self._change(job_id, values, ("waiting", "running"))

    # -- what people change

    def request_stop(self, sweep: str) -> list[Job]:
        """Cancel the waiting jobs of a sweep, and ask for the end of the running one; return those that changed."""
        with self._engine.begin() as connection:
            query = (
                select(jobs).where(jobs.c.sweep == sweep, jobs.c.state.in_(("waiting", "running"))).order_by(jobs.c.id)
            )
            found = _jobs(connection, query.with_for_update())
            for job in found:
                cancelled = {"state": "ended", "outcome": "cancelled", "ended_at": self._now()}
                values = cancelled if job.state == "waiting" else {"stop_requested": True}
                connection.execute(update(jobs).where(jobs.c.id == job.id, jobs.c.state == job.state).values(values))
            return [_job(connection, job.id) for job in found]

    def set_priority(self, sweep: str, priority: int) -> list[Job]:
        """Change the priority of the waiting jobs of a sweep; return them."""
        with self._engine.begin() as connection:
            where = (jobs.c.sweep == sweep, jobs.c.state == "waiting")
            connection.execute(update(jobs).where(*where).values(priority=priority))
            return _jobs(connection, select(jobs).where(*where).order_by(jobs.c.id))

    def remove_sweep(self, sweep: str) -> None:
        """Forget the ended jobs of a sweep that is deleted, and their keys."""
        with self._engine.begin() as connection:
            ids = select(jobs.c.id).where(jobs.c.sweep == sweep, jobs.c.state == "ended")
            connection.execute(delete(submissions).where(submissions.c.job_id.in_(ids)))
            connection.execute(delete(jobs).where(jobs.c.sweep == sweep, jobs.c.state == "ended"))

    # -- looking

    def job(self, job_id: int) -> Job:
        """Return a job.

        Raises:
            NotFoundError: There is none.
        """
        with self._engine.begin() as connection:
            return _job(connection, job_id)

    def jobs(self, *states: JobState, sweep: str | None = None) -> list[Job]:
        """Return jobs in the order in which they came, of some states or all, of one sweep or all."""
        query = select(jobs).order_by(jobs.c.id)
        if states:
            query = query.where(jobs.c.state.in_(states))
        if sweep is not None:
            query = query.where(jobs.c.sweep == sweep)
        with self._engine.begin() as connection:
            return _jobs(connection, query)

    def load(self) -> Load:
        """Return how much there is to do, without reading the jobs one by one."""
        is_open = jobs.c.state != "ended"
        by_kind = select(
            jobs.c.state, jobs.c.verb, func.count(), func.sum(jobs.c.num_cpus), func.min(jobs.c.submitted_at)
        ).where(is_open)
        owners = select(func.count(jobs.c.owner.distinct())).where(is_open)
        with self._engine.begin() as connection:
            rows = connection.execute(by_kind.group_by(jobs.c.state, jobs.c.verb)).all()
            num_owners = connection.execute(owners).scalar_one()
        since = [row[4] for row in rows if row.state == "waiting"]
        return Load(
            {(row.state, row.verb): row[2] for row in rows},
            sum(row[3] for row in rows if row.state == "running"),
            num_owners,
            max(0.0, self._now() - min(since)) if since else 0.0,
        )

    def _change(self, job_id: int, values: Mapping[str, Any], states: Sequence[JobState]) -> Job:
        with self._engine.begin() as connection:
            where = (jobs.c.id == job_id, jobs.c.state.in_(states))
            connection.execute(update(jobs).where(*where).values(dict(values)))
            return _job(connection, job_id)


_OF_ORDER = ("id", "sweep", "owner", "priority", "num_cpus", "state", "num_attempts", "started_at")
_OPEN = (
    select(*(jobs.c[name] for name in _OF_ORDER)).where(jobs.c.state.in_(("waiting", "running"))).order_by(jobs.c.id)
)
"""What says which job is next: there may be thousands, and they are looked at some times a second."""


def _open_jobs(connection: Connection, query: Any) -> tuple[list[Row[Any]], list[Row[Any]]]:
    """Return the first waiting job of each sweep that has no running one, and the running jobs."""
    open_jobs = connection.execute(query).all()
    running = [job for job in open_jobs if job.state == "running"]
    busy = {job.sweep for job in running}
    first: dict[str, Row[Any]] = {}
    for job in open_jobs:
        if job.sweep not in busy:
            first.setdefault(job.sweep, job)
    return list(first.values()), running


def _fits(job: Row[Any], running: Sequence[Row[Any]], num_cpus: float) -> bool:
    """Whether a job's CPUs are free; with nothing running, everything fits."""
    return not running or sum(map(_cpus_of, running)) + _cpus_of(job) <= num_cpus


def _cpus_of(job: Row[Any]) -> float:
    return _finite_cpus(job.num_cpus)


def _finite_cpus(num_cpus: float) -> float:
    """Return the CPUs of a job: earlier versions wrote infinity for a cluster's, which JSON has not."""
    return num_cpus if math.isfinite(num_cpus) else 1.0


def _in_order(connection: Connection, waiting: Sequence[Row[Any]], running: Sequence[Row[Any]]) -> list[Row[Any]]:
    num_running = Counter(job.owner for job in running)
    last_started = _last_started(connection, {job.owner for job in waiting})
    return sorted(
        waiting,
        key=lambda job: (-job.priority, num_running[job.owner], last_started.get(job.owner, 0.0), job.id),
    )


def _last_started(connection: Connection, owners: set[str]) -> dict[str, float]:
    """Return when the last job of each owner began, without those of whom none has."""
    found = select(jobs.c.owner, func.max(jobs.c.started_at).label("last")).where(
        jobs.c.owner.in_(owners), jobs.c.started_at.is_not(None)
    )
    return {row.owner: row.last for row in connection.execute(found.group_by(jobs.c.owner))}


def _jobs(connection: Connection, query: Any) -> list[Job]:
    return [_as_job(row) for row in connection.execute(query).mappings()]


def _job(connection: Connection, job_id: int) -> Job:
    row = connection.execute(select(jobs).where(jobs.c.id == job_id)).mappings().first()
    if row is None:
        raise NotFoundError(f"There is no job {job_id}.", "List the jobs: the queue names them.")
    return _as_job(row)


def _as_job(row: RowMapping) -> Job:
    return Job.model_validate({**row, "num_cpus": _finite_cpus(row["num_cpus"])})

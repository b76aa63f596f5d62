"""Know in a process that a Ray cluster runs as a job which job that is and who asked for it; and whose job one is."""

from __future__ import annotations

import json
import os
from importlib.metadata import PackageNotFoundError, version

from analysis.records import JobRecord, SweepRecord
from policies.errors import CannotRunError
from tune_jobs.store.contract import Sweep
from tune_jobs.store.opening import is_same_place
from tune_jobs.store.urls import is_url, name_of_place

_VARIABLE = "TUNE_JOBS_JOB"


def version_here() -> str:
    """Return this machine's version of tune-jobs."""
    try:
        return version("tune-jobs")
    except PackageNotFoundError:
        return "(not installed)"


def environment_of(job: JobRecord) -> dict[str, str]:
    """Return the environment variables of a job's process; everybody who reaches the cluster can read them."""
    told = {"id": job.id, "address": job.address, "place": job.place, "version": version_here()}
    # A job that is ended from outside has three seconds for its last checkpoints otherwise.
    return {_VARIABLE: json.dumps(told), "RAY_JOB_STOP_WAIT_TIME_S": "60"}


def job_of(record: SweepRecord, place: str) -> JobRecord | None:
    """Return the job that drives a sweep, or drove it last; None: another process did.

    The record of a copy names the original's job, which is none of the copy's: it would be ended with that.

    Args:
        record: The sweep's record.
        place: Where the sweep is.
    """
    job = record.job
    if job is None:
        return None
    if job.place and (is_url(job.place) or is_url(place) or os.path.lexists(job.place)):
        return job if is_same_place(job.place, place) else None
    # Moved since, known here by another path, or of before jobs had places: its id tells the name, see `detached`.
    return job if job.id.rpartition("-")[0] == name_of_place(place) else None


def note_own_job(store: Sweep) -> None:
    """Write into a sweep's record which job drives it from now on; its lock has to be held.

    Raises:
        CannotRunError: The job was asked for by another version of tune-jobs.
    """
    job = _own_job()
    record = store.read_record()
    if record.job != job:
        store.write_record(record.model_copy(update={"job": job}))


def own_job_address() -> str:
    """Return the address of the cluster that runs this process as a job, as who asked for it named it; empty: none."""
    job, _ = _told()
    return "" if job is None else job.address


def _own_job() -> JobRecord | None:
    job, version_there = _told()
    if job is not None and version_there != version_here():
        raise CannotRunError(
            f"The cluster's head has tune-jobs {version_here()}, and this sweep was sent by {version_there}.",
            "Install the same version everywhere.",
        )
    return job


def _told() -> tuple[JobRecord | None, object]:
    """Return the job of this process, and the version of tune-jobs that asked for it."""
    try:
        told = json.loads(os.environ.get(_VARIABLE) or "null")
        if told is None:
            return None, None
        return JobRecord(id=told["id"], address=told["address"], place=told.get("place", "")), told.get("version")
    except (ValueError, TypeError, KeyError, AttributeError):
        # Somebody else's variable: this process is driven by nobody's job.
        return None, None

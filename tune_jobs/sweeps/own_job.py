"""Know in a process that a Ray cluster runs as a job which job that is, and who asked for it."""

from __future__ import annotations

import json
import os
from importlib.metadata import PackageNotFoundError, version

from analysis.records import JobRecord
from policies.errors import CannotRunError
from tune_jobs.store.contract import Sweep

_VARIABLE = "TUNE_JOBS_JOB"


def version_here() -> str:
    """Return this machine's version of tune-jobs."""
    try:
        return version("tune-jobs")
    except PackageNotFoundError:
        return "(not installed)"


def environment_of(job: JobRecord) -> dict[str, str]:
    """Return the environment variables of a job's process; everybody who reaches the cluster can read them."""
    told = {"id": job.id, "address": job.address, "version": version_here()}
    # A job that is ended from outside has three seconds for its last checkpoints otherwise.
    return {_VARIABLE: json.dumps(told), "RAY_JOB_STOP_WAIT_TIME_S": "60"}


def note_own_job(store: Sweep) -> None:
    """Write into a sweep's record which job drives it from now on; its lock has to be held.

    Raises:
        CannotRunError: The job was asked for by another version of tune-jobs.
    """
    job = _own_job()
    record = store.read_record()
    if record.job != job:
        store.write_record(record.model_copy(update={"job": job}))


def _own_job() -> JobRecord | None:
    try:
        told = json.loads(os.environ.get(_VARIABLE) or "null")
        job = None if told is None else JobRecord(id=told["id"], address=told["address"])
    except (ValueError, TypeError, KeyError):
        # Somebody else's variable: this process is driven by nobody's job.
        return None
    if job is not None and told.get("version") != version_here():
        raise CannotRunError(
            f"The cluster's head has tune-jobs {version_here()}, and this sweep was sent by {told.get('version')}.",
            "Install the same version everywhere.",
        )
    return job

"""Describe why a trial or a pack failed: Ray Tune's error, and the end of the process's log."""

from __future__ import annotations

from pathlib import Path

import cloudpickle
from ray.exceptions import RayActorError, RayTaskError
from ray.tune.experiment import Trial

from policies.errors import TuneJobsError, said_by
from tune_jobs.store.logs import died_by
from tune_jobs.store.ownership import OwnershipLostError


def error_of(trial: Trial) -> BaseException | None:
    """Return the error that a trial or a pack of Tune's ended with; None: Tune has written none."""
    # Trial.get_pickled_error looks where Tune syncs to, but nothing has been synced yet; Tune writes the error here.
    path = trial.pickled_error_file
    if not path or not Path(path).is_file():
        return None
    error: BaseException = cloudpickle.loads(Path(path).read_bytes())
    return error


def was_lost(error: BaseException | None) -> bool:
    """Whether a process ended because another one took over its work, which is no failure of a trial."""
    return isinstance(getattr(error, "cause", None), OwnershipLostError)


def describe_failure(error: BaseException | None, tail: str, *, timeout_s: float, what: str = "trial") -> str:
    """Describe why a trial or a pack failed, in one line, followed by the end of its log.

    Args:
        error: The error that Ray Tune reports.
        tail: The end of the log, from `logs.log_tail`.
        timeout_s: The sweep's `iteration_timeout_s`.
        what: What the process ran, a trial or a pack.
    """
    if isinstance(error, RayTaskError):
        cause = error.cause if isinstance(error.cause, BaseException) else error
        message = str(cause) if isinstance(cause, TuneJobsError) else f"{type(cause).__name__}: {said_by(cause)}"
    elif isinstance(error, RayActorError):
        why = died_by(tail, timeout_s) or ("its node was taken away" if error.preempted else "")
        message = f"The process of the {what} died{f': {why}' if why else ''}."
    else:
        message = said_by(error) if error is not None else "Unknown error."
    return f"{message}\n{tail}".strip()

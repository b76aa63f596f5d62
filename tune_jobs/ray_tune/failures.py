"""Describe why a trial or a pack failed: Ray Tune's error, and the end of the process's log."""

from __future__ import annotations

import re

from ray.exceptions import OutOfMemoryError, RayActorError, RayTaskError

from policies.errors import CannotRunError, TuneJobsError, said_by
from tune_jobs.store.logs import died_by
from tune_jobs.store.ownership import OwnershipLostError

_USED_MEMORY = re.compile(r"was ([\d.]+\w*) used / ([\d.]+\w*) limit")


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
    if isinstance(error, RayActorError) and isinstance(error.__cause__, OutOfMemoryError):
        error = error.__cause__
    if isinstance(error, RayTaskError):
        cause = error.cause if isinstance(error.cause, BaseException) else error
        message = str(cause) if isinstance(cause, TuneJobsError) else f"{type(cause).__name__}: {said_by(cause)}"
    elif isinstance(error, RayActorError):
        why = died_by(tail, timeout_s) or ("its node was taken away" if error.preempted else "")
        message = f"The process of the {what} died{f': {why}' if why else ''}."
    elif isinstance(error, OutOfMemoryError):
        used = _USED_MEMORY.search(str(error))
        full = f" ({used[1]} of {used[2]} were used)" if used else ""
        message = f"Ray ended the process of the {what}, as its node ran low on memory{full}."
    else:
        message = said_by(error) if error is not None else "Unknown error."
    return f"{message}\n{tail}".strip()


def going_on(error: CannotRunError, command: str) -> CannotRunError:
    """Return the error that ended a run in the middle, which says how to go on too.

    Args:
        error: The error.
        command: What goes on with it.
    """
    how = f"What is done is kept; continue with `{command}`."
    return CannotRunError(error.message, f"{error.hint} {how}".strip())

"""Say so where a run ends because its storage is gone: nothing of the sweep can be read any more, nor be written."""

from __future__ import annotations

import contextlib
import shlex
import time
from collections.abc import Callable, Iterator

from policies.errors import CannotRunError, TuneJobsError, said_by
from tune_jobs.store.contract import Sweep
from tune_jobs.store.opening import name_for_commands
from tune_jobs.store.urls import is_url


@contextlib.contextmanager
def told_if_it_is_gone(store: Sweep, last_report: Callable[[], float | None]) -> Iterator[None]:
    """Let an error of the block say that the sweep's storage is gone, if it is: what it says itself is a consequence.

    A folder that is not mounted any more, say, looks as if there had never been a sweep, and as if its trials had been
    taken over.

    Args:
        store: The sweep that the block runs.
        last_report: Returns when a trial last reported, Unix time in seconds; None: none has. It has written then.

    Raises:
        CannotRunError: The storage can't be read; the message has the place and since when, the hint how to go on.
    """
    try:
        yield
    except Exception as error:
        why = _why_unreadable(store, error)
        if not why:
            raise
        at = last_report()
        noticed = f"It was missed at {_clock(time.time())}"
        since = f"{noticed}; a trial last reported at {_clock(at)}." if at else f"{noticed}."
        raise CannotRunError(
            f"The storage of sweep {store.name} is gone: {why} {since}",
            "Mount or connect it again. What was saved there is kept with it; continue with "
            f"`tune-jobs resume {shlex.quote(name_for_commands(store))}`.",
        ) from error


def _why_unreadable(store: Sweep, error: Exception) -> str:
    """Return why the sweep can't be read, a sentence with the place; empty: it can, or it is not known."""
    if is_url(store.place):
        from tune_jobs.store.objects.bucket import StorageError

        # The store was asked again and again before there was an error, which names it.
        return error.message if isinstance(error, StorageError) and error.passes else ""
    try:
        store.read_record()
    except (TuneJobsError, OSError) as unreadable:
        said = unreadable.message if isinstance(unreadable, TuneJobsError) else said_by(unreadable)
        return f"{said.rstrip('.')}."
    return ""


def _clock(unix_time: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(unix_time))

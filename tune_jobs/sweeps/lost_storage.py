"""Say so where a run ends because of its storage: it is gone, or refuses what it did before, and how to go on."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

from policies.errors import CannotRunError, TuneJobsError, said_by
from tune_jobs.store.contract import Sweep
from tune_jobs.store.opening import resume_command
from tune_jobs.store.urls import is_url


@contextlib.contextmanager
def told_if_it_is_gone(store: Sweep, last_report: Callable[[], float | None]) -> Iterator[None]:
    """Let an error of the block say that the sweep's storage is gone or refuses, if it does.

    What the error says itself is a consequence then.

    A folder that is not mounted any more, say, looks as if there had never been a sweep, and as if its trials had been
    taken over.

    Args:
        store: The sweep that the block runs.
        last_report: Returns when a trial last reported, Unix time in seconds; None: none has. It has written then.

    Raises:
        CannotRunError: The storage can't be read, or an object store refuses, as credentials have expired, say; the
            message has the place and why, the hint how to go on.
    """
    record = None
    # Asked now: when it is told, nothing can be read.
    with contextlib.suppress(TuneJobsError, OSError):
        record = store.read_record()
    how = f"continue with `{resume_command(store, record)}`."
    try:
        yield
    except Exception as error:
        refused = _refused(store, error)
        if refused is not None:
            raise CannotRunError(refused.message, f"{refused.hint} What is done is kept; {how}".strip()) from error
        why = _why_unreadable(store, error)
        if not why:
            raise
        at = last_report()
        noticed = f"It was missed at {_clock(time.time())}"
        since = f"{noticed}; a trial last reported at {_clock(at)}." if at else f"{noticed}."
        raise CannotRunError(
            f"The storage of sweep {store.name} is gone: {why} {since}",
            f"Mount or connect it again. What was saved there is kept with it; {how}",
        ) from error


def _refused(store: Sweep, error: Exception) -> TuneJobsError | None:
    """Return what an object store refused to do, to which an error is due; None: it did not, or it may do it later."""
    if not is_url(store.place):
        return None
    from tune_jobs.store.objects.bucket import StorageError

    # Whoever lists the records says that they can't be read, which is another kind of error.
    causes = (error, error.__cause__)
    return next((each for each in causes if isinstance(each, StorageError) and not each.passes), None)


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

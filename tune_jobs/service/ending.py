"""Wait for threads and calls as the service ends, but for none without end: a silent database may hold them.

Threads that are left are daemons, and end with the process; what they were about is found again at the next start, as
after a kill. Only a request that waits itself, in a thread that is none, holds the end of the process: all has saved by
then, and whoever sent the signal may kill it.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import TypeVar

from policies.errors import CannotRunError

END_S = 3.0
"""How long a thread that was told to end is waited for."""
ANSWER_S = 5.0
"""How long one call is waited for."""
_MOST_NAMED = 3
_T = TypeVar("_T")
_log = logging.getLogger(__name__)


def join(thread: threading.Thread, limit_s: float = END_S) -> None:
    """Wait for the end of a thread, if it was begun, at most so long; it is logged where it has not come."""
    if thread.is_alive():
        thread.join(limit_s)
    if thread.is_alive():
        tell_left([thread.name], limit_s)


def tell_left(what: Sequence[str], limit_s: float) -> None:
    """Log what is no longer waited for."""
    named = ", ".join(what[:_MOST_NAMED]) + (f" and {len(what) - _MOST_NAMED} more" if len(what) > _MOST_NAMED else "")
    _log.warning("After %g s the service waits no longer, as for a silent database, for: %s.", limit_s, named)


def within(call: Callable[[], _T], limit_s: float = ANSWER_S) -> _T:
    """Return what a call returns, or raise what it raises; it runs in a thread, which may be left to itself.

    Raises:
        CannotRunError: It takes longer.
    """
    answer: Future[_T] = Future()

    def run() -> None:
        try:
            answer.set_result(call())
        except BaseException as error:  # noqa: BLE001 (it is raised where the answer is waited for)
            answer.set_exception(error)

    # Threads of a pool would be joined as the interpreter ends.
    thread = threading.Thread(target=run, name="one call at the end", daemon=True)
    thread.start()
    thread.join(limit_s)
    if not answer.done():
        raise CannotRunError(f"No answer came within {limit_s:g} s.", "Check that the database answers.")
    return answer.result()

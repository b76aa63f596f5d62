"""How long a request to an object store is tried: a run waits for its store, who wants an answer now does not.

A store that was found to be away is not asked by each of those who want an answer now: for a moment all of them are
told so at once, and then one of them finds out whether it is back. Else a hundred questions would wait for nothing, and
with them whoever shares their threads.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar

ANSWER_S = 4.0
"""Seconds in which a store has to answer those who want an answer now."""
_AGAIN_S = 2.0
"""Seconds for which a store that was away is not asked again."""
_impatient: ContextVar[bool] = ContextVar("impatient", default=False)


@contextlib.contextmanager
def impatient() -> Iterator[None]:
    """Want answers of stores now, in the block: an error after some seconds is better than to wait."""
    token = _impatient.set(True)
    try:
        yield
    finally:
        _impatient.reset(token)


def is_impatient() -> bool:
    """Whether an answer is wanted now."""
    return _impatient.get()


class Away:
    """The stores that did not answer lately, and what was said then; threads may share it.

    Args:
        clock: A monotonic clock, in seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._known: dict[str, tuple[float, Exception]] = {}
        self._lock = threading.Lock()

    def error(self, store: str) -> Exception | None:
        """Return why a store is not to be asked now; None: ask it. Of many that come then, one is told to ask."""
        with self._lock:
            until, error = self._known.get(store, (0.0, None))
            now = self._clock()
            if error is not None and now >= until:
                # While this one asks, the others still hold it for away.
                self._known[store] = (now + ANSWER_S + _AGAIN_S, error)
                return None
            return error

    def failed(self, store: str, error: Exception) -> None:
        """Note that a store did not answer."""
        with self._lock:
            self._known[store] = (self._clock() + _AGAIN_S, error)

    def answered(self, store: str) -> None:
        """Note that a store answered."""
        if self._known:
            with self._lock:
                self._known.pop(store, None)


AWAY = Away()
"""What this process knows."""

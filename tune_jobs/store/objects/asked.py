"""A question to the store that is asked before every step of training, and must not hold it up."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from tune_jobs.store.objects.bucket import StorageError

_EVERY_S = 1.0
"""Seconds for which an answer is believed."""
_BELIEVED = 3
"""How many times as long the answer before is believed while a new one is on its way, so that nobody waits for it."""
_WAIT_S = 0.25
"""Seconds that a new answer is waited for after that; if it does not come, the one before holds."""


class Asked:
    """The newest answer of the store.

    Args:
        ask: Asks the store.
    """

    def __init__(self, ask: Callable[[], bool]) -> None:
        self._ask = ask
        self._lock = threading.Lock()
        self._known: bool | None = None
        self._at = -float("inf")
        self._error: StorageError | None = None
        self._asking: threading.Thread | None = None
        self._generation = 0

    def answer(self) -> bool:
        """Return the answer, as it was a moment ago; while the store is away, as it was before.

        Raises:
            StorageError: It was never answered, or for a reason that does not pass.
        """
        with self._lock:
            age = time.monotonic() - self._at
            if self._known is not None and age < _EVERY_S:
                return self._known
            asking = self._asking
            is_new = asking is None or not asking.is_alive()
            if asking is None or is_new:
                asking = threading.Thread(target=self._look, args=(self._generation,), name="question", daemon=True)
                self._asking = asking
                asking.start()
        if self._known is None:
            asking.join()
        elif is_new and age >= _BELIEVED * _EVERY_S:
            asking.join(_WAIT_S)
        with self._lock:
            error = self._error
            if error is not None and (self._known is None or not error.passes):
                raise error.again() from None
            return bool(self._known)

    def forget(self) -> None:
        """Ask anew next time, because the answer has been changed."""
        with self._lock:
            self._generation += 1
            self._known, self._at, self._asking, self._error = None, -float("inf"), None, None

    def _look(self, generation: int) -> None:
        answer, failed = None, None
        try:
            answer = self._ask()
        except StorageError as error:
            failed = error
        with self._lock:
            if generation == self._generation:
                self._known = self._known if answer is None else answer
                self._at, self._error = time.monotonic(), failed

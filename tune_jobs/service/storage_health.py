"""Find out whether the service's storage answers, however often it is asked for."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from policies.errors import CannotRunError, TuneJobsError
from tune_jobs.store.contract import Storage
from tune_jobs.store.patience import impatient
from tune_jobs.store.urls import is_url

_EVERY_S = 5.0
"""Seconds for which an answer is believed: anybody may ask, and a store wants money for each request."""
_NO_SWEEP = ".health"


def is_of_store(storage: Storage, error: TuneJobsError) -> bool:
    """Whether an error in looking at a sweep is its store's, and so about all: a folder's is about that sweep alone."""
    return isinstance(error, CannotRunError) and is_url(storage.place)


class StorageHealth:
    """Whether an object store answers; a folder is taken for there. Threads may share it.

    Args:
        storage: The sweeps.
        clock: A monotonic clock, in seconds.
    """

    def __init__(self, storage: Storage, clock: Callable[[], float] = time.monotonic) -> None:
        self._storage, self._clock = storage, clock
        self._asking = threading.Lock()
        self._at, self._answered = -float("inf"), True

    def is_there(self) -> bool:
        """Whether it answered a moment ago; while one asks, others are told what was so before."""
        if is_url(self._storage.place) and self._asking.acquire(blocking=False):
            try:
                if self._clock() - self._at >= _EVERY_S:
                    self._answered = self._asked()
                    self._at = self._clock()
            finally:
                self._asking.release()
        return self._answered

    def _asked(self) -> bool:
        try:
            with impatient():
                self._storage.is_taken(_NO_SWEEP)
        except TuneJobsError:
            return False
        return True

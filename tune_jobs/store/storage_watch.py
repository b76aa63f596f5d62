"""Notice while a sweep runs that its folder is gone, before its trials fail by that."""

from __future__ import annotations

import time
from collections.abc import Callable

from policies.errors import CannotRunError, CheckpointError
from tune_jobs.store.contract import Sweep
from tune_jobs.store.urls import is_url

_LOOK_S = 1.0
# A file server that starts again is back in a moment, and is waited for by the system in most cases.
_PATIENCE_S = 3.0


class StorageWatch:
    """Looks once a second whether a sweep's record is there.

    An object store is not asked, which would cost a request each time; what it does not do is an error of its own.

    Args:
        store: The sweep.
        clock: A monotonic clock, in seconds.
    """

    def __init__(self, store: Sweep, clock: Callable[[], float] = time.monotonic) -> None:
        self._store, self._clock = store, clock
        self._looks = not is_url(store.place)
        self._looked_at = self._seen_at = clock()

    def check(self) -> None:
        """Look, if it is time to.

        Raises:
            CannotRunError: The record has not been there for three seconds.
        """
        now = self._clock()
        if not self._looks or now - self._looked_at < _LOOK_S:
            return
        self._looked_at = now
        try:
            is_there = self._store.exists()
        except CheckpointError:
            # A file system that answers by errors of its own.
            is_there = False
        if is_there:
            self._seen_at = now
        elif now - self._seen_at >= _PATIENCE_S:
            raise CannotRunError(f"{self._store.place} has not been there for {now - self._seen_at:.0f} s.")

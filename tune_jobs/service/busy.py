"""Locks of what takes long: whoever has no time to wait for one is told that it is held."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from contextvars import ContextVar

_waits: ContextVar[bool] = ContextVar("waits", default=True)


class BusyError(Exception):
    """Somebody else holds a lock.

    Args:
        lock: It.
    """

    def __init__(self, lock: threading.Lock) -> None:
        super().__init__("Somebody else does this just now.")
        self.lock = lock


@contextlib.contextmanager
def without_waiting() -> Iterator[None]:
    """In the block, wait for no lock that is `held`."""
    token = _waits.set(False)
    try:
        yield
    finally:
        _waits.reset(token)


@contextlib.contextmanager
def held(lock: threading.Lock) -> Iterator[None]:
    """Hold a lock for the block.

    Raises:
        BusyError: Somebody else holds it, and it is not to be waited for.
    """
    if not lock.acquire(blocking=_waits.get()):
        raise BusyError(lock)
    try:
        yield
    finally:
        lock.release()

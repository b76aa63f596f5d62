"""Do single requests to the store side by side: each waits for its own answer, and for no other."""

from __future__ import annotations

import contextlib
import contextvars
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

_T = TypeVar("_T")
_R = TypeVar("_R")

AT_ONCE = 32
"""Requests side by side when much is read or written."""

_pools: dict[int, ThreadPoolExecutor] = {}
_here = threading.local()


def side_by_side(do: Callable[[_T], _R], items: Iterable[_T]) -> list[_R]:
    """Call a function for each of some items at once, and return the results in their order.

    Args:
        do: Makes one request, or some of which each needs the one before.
        items: What it is called with.

    Raises:
        Exception: What it raised for the first of the items for which it raised one; it was called for all of them.
    """
    wanted = list(items)
    begun: list[Future[_R]] = []
    if not getattr(_here, "is_in_pool", False):
        # An interpreter that ends starts no threads any more; the last uploads are made all the same.
        with contextlib.suppress(RuntimeError):
            # Whoever wants an answer now wants it there, too.
            begun.extend(_pool().submit(contextvars.copy_context().run, do, item) for item in wanted[1:])
    own = [_done(do, item) for item in (*wanted[:1], *wanted[1 + len(begun) :])]
    return [future.result() for future in (*own[:1], *begun, *own[1:])]


def _done(do: Callable[[_T], _R], item: _T) -> Future[_R]:
    future: Future[_R] = Future()
    try:
        future.set_result(do(item))
    except Exception as error:  # noqa: BLE001 (raised again where the others have been done)
        future.set_exception(error)
    return future


def _pool() -> ThreadPoolExecutor:
    # A process that was forked has none of its parent's threads.
    pid = os.getpid()
    if pid not in _pools:
        _pools.clear()
        _pools[pid] = ThreadPoolExecutor(AT_ONCE, "requests", initializer=_begin)
    return _pools[pid]


def _begin() -> None:
    # Whoever waits here for others of the pool might wait for itself.
    _here.is_in_pool = True

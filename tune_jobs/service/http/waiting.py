"""Routes that ask for what somebody else may be making: they wait for it outside of the threads for requests."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Coroutine
from typing import Any, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

import anyio
from anyio import to_thread

from tune_jobs.service.busy import BusyError, without_waiting

_P = ParamSpec("_P")
_T = TypeVar("_T")

_queues: WeakKeyDictionary[threading.Lock, anyio.CapacityLimiter] = WeakKeyDictionary()
"""The place of the one thread that waits for each lock, and those who wait for that place."""


def waits_aside(route: Callable[_P, _T]) -> Callable[_P, Coroutine[Any, Any, _T]]:
    """Let a route that finds a lock `held` begin anew in its turn, and take no thread until then.

    Of a hundred pages that ask for what takes ten seconds one makes it, one waits with a thread of its own, and the
    threads for requests are free for the others.
    """

    def at_once(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        with without_waiting():
            return route(*args, **kwargs)

    @functools.wraps(route)
    async def asked(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        try:
            return await to_thread.run_sync(functools.partial(at_once, *args, **kwargs))
        except BusyError as error:
            queue = _queues.setdefault(error.lock, anyio.CapacityLimiter(1))
        return await to_thread.run_sync(functools.partial(route, *args, **kwargs), limiter=queue)

    return asked

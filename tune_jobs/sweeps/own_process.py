"""The process that runs a sweep for another one: its requests and its answers; see `apart`."""

from __future__ import annotations

import contextlib
import logging
import logging.handlers
import os
import pickle
import pkgutil
import signal
import sys
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from policies.envs.modules import allow_modules
from policies.errors import said_by, tellable
from policies.parents import end_with_parent
from tune_jobs.process.interruption import ASKED, end_in_order
from tune_jobs.sweeps.interrupted import SweepInterrupted

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, ASKED)
RESULT, ERROR, LOG = "result", "error", "log"
"""The kinds of answers."""


@dataclass(frozen=True)
class Request:
    """A call of a function, and the settings of the asking process that this one has to take over."""

    function: str
    """The function's `module:function`."""
    args: tuple[Any, ...]
    kwargs: Mapping[str, Any]
    path: tuple[str, ...]
    """The import path."""
    script: str
    """The script in `sys.argv`: Ray and the guard let their processes import what lies beside it."""
    main_file: str | None
    """The file of the main module; None: the program has no script, as in a notebook."""
    modules: tuple[str, ...]
    """The user's own modules that are allowed."""
    ray_address: str | None
    """The address of the Ray that the asking process has joined itself; None: it has not joined any."""


def main(parent: int, descriptor: int) -> None:
    """Do what the parent asks, and answer.

    Args:
        parent: The parent's process id.
        descriptor: Descriptor of this end of the pipe to the parent.
    """
    end_with_parent(parent=parent)
    end_in_order(ASKED)
    # In services, a thread that waits for signals blocks them in other threads and in processes these start.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    os.set_inheritable(descriptor, False)  # noqa: FBT003 (takes no keyword)
    connection = Connection(descriptor)
    telling = _Telling(connection)
    logging.getLogger().addHandler(telling)
    try:
        answer = (RESULT, _done(connection.recv()))
    except BaseException as error:  # noqa: BLE001 (the parent raises it, even a KeyboardInterrupt)
        answer = (ERROR, _portable(error))
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    logging.getLogger().removeHandler(telling)
    with contextlib.suppress(OSError):
        connection.send(answer)


def _done(request: Request) -> Any:
    # Imported only here because it needs NumPy: signals have to be handled before.
    from tune_jobs.sweeps.live_view import share_terminal

    share_terminal()
    sys.path[:] = request.path
    sys.argv[:] = [request.script]
    if request.main_file is not None:
        sys.modules["__main__"].__file__ = request.main_file
    allow_modules(request.modules)
    function = pkgutil.resolve_name(request.function)
    with contextlib.ExitStack() as stack:
        if request.ray_address is not None:
            from tune_jobs.ray_tune.cluster import connect

            stack.enter_context(connect(request.ray_address, is_users=True))
        return function(*request.args, **request.kwargs)


def _portable(error: BaseException) -> BaseException:
    """Return the error, or one with the same message if it cannot be pickled."""
    if isinstance(error, KeyboardInterrupt) and not isinstance(error, SweepInterrupted):
        return SweepInterrupted()
    said = "".join(traceback.format_exception(error))
    if isinstance(error, Exception):
        error = tellable(error)
    error.add_note(f"In the process that ran the sweep:\n{said}")
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301 (our own)
    except Exception:  # noqa: BLE001 (exceptions of other code)
        return RuntimeError(f"{type(error).__name__}: {said_by(error)}\n{said}")
    return error


class _Telling(logging.handlers.QueueHandler):
    """Sends log records to the parent, whose logging settings apply to them."""

    def __init__(self, connection: Connection[Any, Any]) -> None:
        super().__init__(connection)  # type: ignore[arg-type]  # only `enqueue` uses it

    def enqueue(self, record: logging.LogRecord) -> None:
        """Send a log record to the parent."""
        with contextlib.suppress(OSError):
            self.queue.send((LOG, record))  # type: ignore[attr-defined]

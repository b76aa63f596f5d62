"""Wait for what a child process answers through a pipe."""

from __future__ import annotations

import select
from collections.abc import Callable
from multiprocessing.connection import Connection

_LOOK_MS = 500
"""The time between two looks at the process while no answer comes."""


def wait_for_answer(connection: Connection, has_ended: Callable[[], bool]) -> None:
    """Wait until something can be received.

    That the pipe is closed is not enough to notice that a process has ended: those that it has forked, as simulators of
    an environment, hold its end of the pipe, too.

    Args:
        connection: This end of the pipe.
        has_ended: Whether the process has ended.

    Raises:
        EOFError: It has, and left nothing to receive.
        OSError: The connection is closed at this end.
    """
    poll = select.poll()  # takes a fourth of the time of the connection's own, which asks this in the end
    poll.register(connection.fileno(), select.POLLIN)
    while not poll.poll(_LOOK_MS):
        if has_ended() and not poll.poll(0):  # it may have answered just before
            raise EOFError

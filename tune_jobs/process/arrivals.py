"""Know of signals at the moment they reach this process.

Python calls a handler when the main thread is back from native code, which may wait for minutes for another process,
one that the same signal ended, say. What the system calls writes the signal's number into a pipe before that.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator

_NONE = -1
_CHUNK = 1 << 12
# Where the numbers are written to while a block notes them.
_writing = _NONE


@contextlib.contextmanager
def noting_arrivals() -> Iterator[Callable[[], frozenset[int]]]:
    """Note which signals arrive while the block runs, of those that have a handler in Python; for the main thread.

    Where the process has a use of its own for what the system writes, as an event loop that handles signals, nothing
    is noted.

    Yields:
        A function that returns the numbers of the signals that have arrived; any thread may call it, also later.
    """
    global _writing  # noqa: PLW0603 (a process has one)
    arrived: set[int] = set()
    # Held while the pipe is read, whose number may be another file's once it is closed.
    in_use = threading.Lock()
    is_open = True
    reading, writing = os.pipe()
    for end in (reading, writing):
        os.set_blocking(end, False)

    def look() -> frozenset[int]:
        with in_use, contextlib.suppress(BlockingIOError):
            while is_open and (numbers := os.read(reading, _CHUNK)):
                arrived.update(numbers)
        return frozenset(arrived)

    before = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    if before != _NONE:
        signal.set_wakeup_fd(before)
    else:
        _writing = writing
    try:
        yield look
    finally:
        if _writing == writing:
            _forget()
        look()
        with in_use:
            is_open = False
            os.close(reading)
            os.close(writing)


def _forget() -> None:
    """Let the system write nothing into the pipe from now on."""
    global _writing
    # Whoever has put another one in its place meanwhile keeps it.
    ours, _writing = _writing, _NONE
    if ours != _NONE and (found := signal.set_wakeup_fd(_NONE)) not in (ours, _NONE):
        signal.set_wakeup_fd(found)


# The signals of a forked process are not those of this one, whose pipe it has.
os.register_at_fork(after_in_child=_forget)

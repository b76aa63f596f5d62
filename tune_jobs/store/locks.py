"""Locks between processes, made of files; the system frees them when their process ends, however it ends.

The holder of a lock has it exclusively. A process that asks whether the lock is held takes it for a moment, shared with
others that ask. So a process that wants the lock and meets only those that ask knows that it is free, and tries again.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import random
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from policies.errors import CannotRunError
from policies.files import refuse_others

_TAKEN = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)
_PATIENCE_S = 60.0
"""Seconds to try; asking takes only microseconds, unless that process is stopped just then."""


@contextlib.contextmanager
def held(path: Path, message: str, hint: str) -> Iterator[None]:
    """Hold the lock of a file, which is made if it is missing, or raise at once.

    Args:
        path: The file.
        message: The error's message if another process holds it.
        hint: The error's hint if another process holds it.

    Raises:
        CannotRunError: Another process holds it, or it cannot be written or locked.
    """
    try:
        descriptor = _opened(path, os.O_RDWR | os.O_CREAT)
    except OSError as error:
        raise _unusable(path, "written", error) from error
    try:
        if not _take(path, descriptor):
            raise CannotRunError(message, hint)
        yield
    finally:
        os.close(descriptor)


def is_held(path: Path) -> bool:
    """Whether a process holds the lock of a file; asking keeps no process from getting it.

    Raises:
        CannotRunError: The file cannot be read.
    """
    try:
        # Opened for reading, so that this works for sweeps of other users too.
        descriptor = _opened(path, os.O_RDONLY)
    except FileNotFoundError:
        return False
    except OSError as error:
        raise _unusable(path, "read", error) from error
    try:
        return not _try(descriptor, fcntl.LOCK_SH)
    except OSError:
        # If the file system has no locks, nothing is locked.
        return False
    finally:
        os.close(descriptor)


def _unusable(path: Path, use: Literal["read", "written"], error: OSError) -> CannotRunError:
    reason = "it is a symbolic link" if error.errno == errno.ELOOP else error.strerror
    return CannotRunError(
        f"The sweep's lock {path} cannot be {use}: {reason}.", "Check the folder and its permissions."
    )


def _opened(path: Path, flags: int) -> int:
    # A symbolic link is not followed, as its target is not part of the sweep; and a named pipe is not waited for.
    descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK, 0o666)
    try:
        refuse_others(os.fstat(descriptor), path)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _take(path: Path, descriptor: int) -> bool:
    """Lock a file exclusively; return False if another process holds it."""
    deadline = time.monotonic() + _PATIENCE_S
    try:
        while not _try(descriptor, fcntl.LOCK_EX):
            # A process that shares the lock with this one only asks; otherwise it holds the lock.
            if not _try(descriptor, fcntl.LOCK_SH):
                return False
            fcntl.flock(descriptor, fcntl.LOCK_UN)
            if time.monotonic() > deadline:
                raise CannotRunError(
                    f"The lock {path} cannot be taken, because other processes ask for it all the time.",
                    "End the program that polls the sweep's status, or let it wait between two calls.",
                )
            time.sleep(random.uniform(0.0, 0.01))
    except OSError as error:
        raise CannotRunError(
            f"{path} cannot be locked: {error.strerror}.", "Choose a storage folder whose file system has locks."
        ) from error
    return True


def _try(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in _TAKEN:
            return False
        raise
    return True

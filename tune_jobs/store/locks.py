"""Locks between processes, by files; the system frees them when their process ends, however it ends.

Who holds a lock has it alone (exclusive); who asks whether it is held takes it for a moment, together with others who
ask (shared). So whoever wants the lock and meets only those who ask knows that it is free, and tries again.
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

from policies.errors import CannotRunError
from policies.files import refuse_others

_TAKEN = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)
_PATIENCE_S = 60.0
"""Each that asks does so for microseconds, if it is not stopped just then."""


@contextlib.contextmanager
def held(path: Path, message: str, hint: str) -> Iterator[None]:
    """Hold the lock of a file, which is made if it is missing, or raise at once.

    Args:
        path: The file.
        message: What to say if another process holds it.
        hint: What to do then.

    Raises:
        CannotRunError: Another process holds it, or it cannot be written or locked.
    """
    try:
        descriptor = _opened(path, os.O_RDWR | os.O_CREAT)
    except OSError as error:
        reason = "it is a symbolic link" if error.errno == errno.ELOOP else error.strerror
        raise CannotRunError(
            f"The sweep's lock {path} cannot be written: {reason}.", "Check the folder and its permissions."
        ) from error
    try:
        if not _take(path, descriptor):
            raise CannotRunError(message, hint)
        yield
    finally:
        os.close(descriptor)


def is_held(path: Path) -> bool:
    """Whether a process holds the lock of a file; nobody who wants it is kept from it by this question.

    Raises:
        CannotRunError: The file cannot be read.
    """
    try:
        # Read only: of a sweep of somebody else's, too, one may know whether it runs.
        descriptor = _opened(path, os.O_RDONLY)
    except FileNotFoundError:
        return False
    except OSError as error:
        reason = "it is a symbolic link" if error.errno == errno.ELOOP else error.strerror
        raise CannotRunError(
            f"The sweep's lock {path} cannot be read: {reason}.", "Check the folder and its permissions."
        ) from error
    try:
        return not _try(descriptor, fcntl.LOCK_SH)
    except OSError:
        # Where nothing can be locked, nothing is.
        return False
    finally:
        os.close(descriptor)


def _opened(path: Path, flags: int) -> int:
    # Not through a symbolic link: the file it points to is none of ours. Nor does it wait for a pipe's other end.
    descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK, 0o666)
    try:
        refuse_others(os.fstat(descriptor), path)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _take(path: Path, descriptor: int) -> bool:
    """Lock a file for oneself alone; False: another process holds it."""
    deadline = time.monotonic() + _PATIENCE_S
    try:
        while not _try(descriptor, fcntl.LOCK_EX):
            # Who shares it with this process only asks; who does not, holds it.
            if not _try(descriptor, fcntl.LOCK_SH):
                return False
            fcntl.flock(descriptor, fcntl.LOCK_UN)
            if time.monotonic() > deadline:
                raise CannotRunError(
                    f"Other processes ask for the lock {path} all the time.",
                    "End what polls the sweep's status, or let it wait between its questions.",
                )
            time.sleep(random.uniform(0.0, 0.01))
    except OSError as error:
        raise CannotRunError(
            f"{path} cannot be locked: {error.strerror}.", "Choose storage whose file system has locks."
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

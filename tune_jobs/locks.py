"""Locks between processes, by files; the system frees them when their process ends, however it ends."""

from __future__ import annotations

import contextlib
import errno
import fcntl
from collections.abc import Iterator
from pathlib import Path

from policies.errors import CannotRunError


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
        file = path.open("a")
    except OSError as error:
        raise CannotRunError(
            f"The sweep folder {path.parent} cannot be written: {error.strerror}.", "Check its permissions."
        ) from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES):
                raise CannotRunError(message, hint) from error
            raise CannotRunError(
                f"{path} cannot be locked: {error.strerror}.", "Choose storage whose file system has locks."
            ) from error
        yield

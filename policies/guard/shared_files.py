"""The files that the guard and its child share."""

from __future__ import annotations

import contextlib
import errno
import tempfile
from typing import IO

from policies.envs.calls import PAGE_BYTES
from policies.errors import CannotRunError


def shared_files() -> tuple[IO[bytes], IO[bytes]]:
    """Return the file of the page that calls are written to, and the file that the fault handler writes to.

    Raises:
        CannotRunError: No temporary file can be written.
    """
    try:
        with contextlib.ExitStack() as made:
            page: IO[bytes] = made.enter_context(tempfile.TemporaryFile())
            # Zeros are written: of a file that was only made as long, a file system in memory allocates the block when
            # it is touched, and if it is full by then, that ends the process by SIGBUS.
            page.write(bytes(PAGE_BYTES))
            page.flush()
            dump: IO[bytes] = made.enter_context(tempfile.TemporaryFile())
            made.pop_all()
            return page, dump
    except OSError as error:
        # Unknown where no folder can be written: the error then names those that were tried.
        where = f" in {tempfile.tempdir}" if tempfile.tempdir else ""
        many = error.errno in (errno.EMFILE, errno.ENFILE)
        raise CannotRunError(
            f"Environments are run with temporary files, and none can be written{where}: {error.strerror}.",
            "Raise the limit of open files (`ulimit -n`), or close some."
            if many
            else "Free space there, or set TMPDIR to another folder that can be written.",
        ) from error

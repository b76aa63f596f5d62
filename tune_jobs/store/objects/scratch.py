"""Folders of this machine for a sweep whose files are elsewhere: what was fetched, what waits to be uploaded, logs.

Nothing here is missed when it is gone. Each process has a folder of its own, which is removed when it ends, or by a
later process if it was killed, and in it one for each sweep that it opens, which is removed with what opened it. Logs
and what users open are in a folder that the processes of this machine share.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import functools
import hashlib
import os
import secrets
import shutil
import stat
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path

from policies.errors import CannotRunError
from policies.files import write_atomic
from policies.parents import is_gone, this_process
from tune_jobs.store.objects.url import ObjectUrl

VARIABLE = "TUNE_JOBS_SCRATCH"
"""Where these folders are; without it, in the system's folder for temporary files."""
_PROCESS = "process"
_OF_A_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES)
_HINT = f"Free space there, or set {VARIABLE} to another folder that can be written."


def shared_folder(url: ObjectUrl) -> Path:
    """Return this machine's folder for a sweep, which processes of the same user share.

    Raises:
        CannotRunError: It cannot be made, or is another user's.
    """
    # Two storages of one name are two; the name is for whoever looks.
    key = hashlib.sha256(str(url).encode()).hexdigest()[:12]
    folder = _root() / f"{url.name or url.bucket}-{key}"
    make_local(folder)
    return folder


@functools.cache
def _own(pid: int) -> Path:
    """Return a new folder of this process alone; `pid` is its id, as a forked process needs another."""
    folder = _root() / f"of-{pid}-{secrets.token_hex(4)}"
    make_local(folder)
    write_local(folder / _PROCESS, this_process())
    _remove_abandoned()
    atexit.register(_remove, folder, pid)
    return folder


def own_folder(owner: object | None = None) -> Path:
    """Return a new empty folder that is removed when this process ends, or before, with its owner.

    Args:
        owner: What needs it; None: this process. A service opens a sweep with every look, for weeks.

    Raises:
        CannotRunError: It cannot be made.
    """
    folder = _own(os.getpid()) / secrets.token_hex(6)
    make_local(folder)
    if owner is not None:
        # All are removed at the end of the process, and a fork leaves its parent's alone.
        weakref.finalize(owner, _remove, folder, os.getpid()).atexit = False
    return folder


@contextlib.contextmanager
def filling() -> Iterator[None]:
    """Say of which folders it is if a file of this machine cannot be written in the block; the store is not to blame.

    Raises:
        CannotRunError: It cannot be written, as the disk is full, say.
    """
    try:
        yield
    except OSError as error:
        raise _cannot_fill(error) from error
    except CannotRunError as error:
        # As `write_atomic` and its like say it, of a file whose name tells a user nothing.
        cause = error.__cause__
        if not isinstance(cause, OSError) or cause.errno not in _OF_A_DISK:
            raise
        raise _cannot_fill(cause) from cause


def write_local(path: Path, data: bytes | str) -> None:
    """Write a file into one of these folders, as `write_atomic`.

    Raises:
        CannotRunError: It cannot be written.
    """
    with filling():
        write_atomic(path, data)


def grow_local(path: Path, data: bytes, offset: int = 0) -> None:
    """Write a file into one of these folders; one that begins like it stays the same file, for who has it open.

    Args:
        path: The file.
        data: What it is to have from the offset on.
        offset: How many bytes of the present file stay; they are not read.

    Raises:
        CannotRunError: It cannot be written.
    """
    if not offset and not path.exists():
        write_local(path, data)
        return
    with path.open("rb") as file:
        file.seek(offset)
        present = file.read()
    if not data.startswith(present):
        write_local(path, path.read_bytes()[:offset] + data)
        return
    with filling(), path.open("ab") as file:
        file.write(data[len(present) :])


def _cannot_fill(error: OSError) -> CannotRunError:
    return CannotRunError(f"Files of this machine cannot be written to {_place()}: {_reason(error)}.", _HINT)


def _reason(error: OSError) -> str:
    if isinstance(error, shutil.Error) and error.args and isinstance(error.args[0], list):
        # Of a folder that is copied, what was wrong with each of its files.
        return str(error.args[0][0][-1])
    return error.strerror or str(error)


def _remove(folder: Path, pid: int) -> None:
    if os.getpid() == pid:
        shutil.rmtree(folder, ignore_errors=True)


def _remove_abandoned() -> None:
    for path in _root().glob("of-*"):
        with contextlib.suppress(OSError, ValueError):
            if is_gone((path / _PROCESS).read_text(encoding="ascii")):
                shutil.rmtree(path, ignore_errors=True)


def _place() -> Path:
    given = os.environ.get(VARIABLE)
    return Path(given) if given else Path(tempfile.gettempdir()) / f"tune-jobs-{os.getuid()}"


def _root() -> Path:
    root = _place()
    make_local(root)
    found = root.lstat()
    # In a folder for all, somebody else may have been there first.
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise CannotRunError(f"{root} is no folder of this user.", f"Set {VARIABLE} to a folder of your own.")
    return root


def make_local(folder: Path) -> None:
    """Make a folder in one of these, if it does not exist, and those above it.

    Raises:
        CannotRunError: It cannot be made.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise CannotRunError(
            f"The folder {folder} for files of this machine cannot be made: {error.strerror or error}.", _HINT
        ) from error

"""Who may write: of several processes that took something up one after the other, the last one.

A sweep that is run, a pack and a trial have an owner each: the process that took it up last. Its epoch, larger than all
before, is in the file `.owner` of the sweep, of the trial, or of the pack. Who writes holds that file's lock and finds
its own epoch there, so no other process can take it up between the check and the write; who finds another one has lost
what it owned and leaves it alone. So a process that outlives its driver, or that everybody believes dead, can do no
harm: it may still compute, but nothing of it is written.

A trial is taken up under its pack's or its sweep's owner: a process of an earlier run can't take it back.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path

from policies.errors import CannotRunError
from policies.files import open_regular, refuse_others
from tune_jobs.store.names import OWNER
from tune_jobs.store.places import within
from tune_jobs.store.trial_contract import Ownership

# One write of this many bytes replaces all that was there: a kill leaves the old content or the new.
_LINE_BYTES = 128
_PATIENCE_S = 60.0
_BUSY = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)


class OwnershipLostError(CannotRunError):
    """Another process has taken up what this one was working on: it must not write there any more."""


class Owner:
    """The ownership that this process, or the one that passed the token on, has taken.

    Args:
        path: The owner file.
        token: What it holds as long as nobody else has taken it up: its line.
    """

    def __init__(self, path: Path, token: str) -> None:
        self.path = path
        self.token = token
        self._descriptor: int | None = None
        # Locks of files are between processes; this one is between the threads of this process.
        self._lock = threading.Lock()

    def __del__(self) -> None:
        self._close()

    def release(self) -> None:
        """Close its file, which is opened again if it is needed: who holds this object may be in no hurry to let go."""
        with self._lock:
            self._close()

    def _close(self) -> None:
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            with contextlib.suppress(OSError):
                os.close(descriptor)

    @classmethod
    def take(cls, path: Path, under: Ownership | None = None) -> Owner:
        """Become the owner; whoever was it before has lost it.

        Args:
            path: The owner file; made if it is missing.
            under: Of what it is a part of: it is taken only as long as that is still owned.

        Raises:
            OwnershipLostError: `under` has been taken by another process.
            CannotRunError: The file cannot be written or locked.
        """
        owner = cls(path, "")
        with owner._locked() as descriptor:
            if under is not None:
                under.check()
            number, _, _ = _read(descriptor).partition(" ")
            # After a line that can't be read the epochs begin anew; the random part still tells them apart.
            epoch = int(number) + 1 if number.isdecimal() else 1
            line = f"{epoch} {secrets.token_hex(8)} {os.getpid()} {socket.gethostname()}"
            owner.token = line.encode("ascii", "replace")[: _LINE_BYTES - 1].decode("ascii").strip()
            os.pwrite(descriptor, owner.token.ljust(_LINE_BYTES - 1).encode("ascii") + b"\n", 0)
        return owner

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Write in the block: nobody can take it up meanwhile. Not to be nested.

        Raises:
            OwnershipLostError: Another process has taken it up.
            CannotRunError: The file cannot be locked.
        """
        with self._locked() as descriptor:
            if _read(descriptor) != self.token:
                raise self._lost()
            yield

    def is_current(self) -> bool:
        """Whether nobody else has taken it up, as far as can be seen without the lock.

        Raises:
            OSError: The file is there and cannot be read.
        """
        try:
            return _line(self.path) == self.token
        except FileNotFoundError:
            return False

    def check(self) -> None:
        """Raise if another process has taken it up.

        Raises:
            OwnershipLostError: It has.
        """
        if not self.is_current():
            raise self._lost()

    @contextlib.contextmanager
    def _locked(self) -> Iterator[int]:
        with self._lock:
            try:
                if self._descriptor is None:
                    self.path.parent.mkdir(parents=True, exist_ok=True)
                    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
                    self._descriptor = os.open(self.path, flags, 0o666)
                refuse_others(os.fstat(self._descriptor), self.path)
                self._wait(self._descriptor)
            except OSError as error:
                raise CannotRunError(
                    f"{self.path} cannot be written and locked: {error.strerror}.",
                    "Check its permissions, and that the file system of the storage has locks.",
                ) from error
            try:
                yield self._descriptor
            finally:
                fcntl.flock(self._descriptor, fcntl.LOCK_UN)

    def _wait(self, descriptor: int) -> None:
        """Lock the file; others hold it for milliseconds."""
        deadline, pause_s = time.monotonic() + _PATIENCE_S, 0.001
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno not in _BUSY:
                    raise
            else:
                return
            if time.monotonic() > deadline:
                raise CannotRunError(
                    f"{self.path} has been locked for {_PATIENCE_S:.0f} s by {_read(descriptor) or 'nobody'!r} "
                    "(epoch, key, process, machine), which may be stopped or wait for its disk.",
                    "End that process, then go on with the sweep.",
                )
            time.sleep(pause_s)
            pause_s = min(0.05, 2 * pause_s)

    def _lost(self) -> OwnershipLostError:
        by = ""
        with contextlib.suppress(OSError):
            by = " ".join(_line(self.path).split()[2:])
        return OwnershipLostError(
            f"{self.path.parent} has been taken up by another process" + (f" ({by})." if by else "."),
            "Leave it to that one; this one writes nothing there any more.",
        )


class OwnedFolder:
    """A folder that one process at a time writes to: the one that took it last."""

    _owner: Owner | None = None

    @property
    def folder(self) -> Path:
        """Its path."""
        raise NotImplementedError

    def take(self, under: Ownership | None = None) -> None:
        """Become the process that writes here; see `Owner.take`.

        Raises:
            OwnershipLostError: `under` is another's by now.
        """
        self._owner = Owner.take(within(self.folder, OWNER), under)

    def owned(self) -> AbstractContextManager[None]:
        """What is entered around each write; nothing to who only reads, and has not taken the folder.

        Raises:
            OwnershipLostError: Another process has taken it.
        """
        return contextlib.nullcontext() if self._owner is None else self._owner.held()

    def is_lost(self) -> bool:
        """Whether this process has taken the folder, and another one after it."""
        return self._owner is not None and not self._owner.is_current()


def _read(descriptor: int) -> str:
    return os.pread(descriptor, _LINE_BYTES, 0).decode("ascii", "replace").strip()


def _line(path: Path) -> str:
    with open_regular(path) as file:
        return file.read(_LINE_BYTES).decode("ascii", "replace").strip()

"""Decide who may write: of several processes that took something one after the other, only the last one.

A running sweep, a pack and a trial each have an owner: the process that took it last. The owner's epoch, larger than
all before, is in the file `.owner` of the sweep, the trial or the pack. A process that writes holds that file's lock
and checks that the epoch is its own, so no other process can take it between the check and the write. If the epoch is
another one, the process has lost its ownership and stops writing. So a process that outlives its driver can do no harm:
it may still compute, but it writes nothing.

A trial is taken under its pack's or its sweep's owner, so that a process of an earlier run can't take it back.
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
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path

from policies.errors import CannotRunError
from policies.files import open_regular, refuse_others
from tune_jobs.store.names import OWNER
from tune_jobs.store.places import within
from tune_jobs.store.trial_contract import Ownership

# A single write of this length replaces the whole content, so a kill leaves either the old content or the new.
_LINE_BYTES = 128
_PATIENCE_S = 60.0
_AWAY_S = 3.0
"""How long a folder may be away before it counts as gone, as storages of other machines are for moments."""
_BUSY = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)


class OwnershipLostError(CannotRunError):
    """Another process has taken over the work of this one, which must not write there any more."""


class Owner:
    """The ownership that this process, or the one that passed the token on, has taken.

    Args:
        path: The owner file.
        token: The owner's line, which the file contains until another process becomes the owner.
    """

    def __init__(self, path: Path, token: str) -> None:
        self.path = path
        self.token = token
        self._descriptor: int | None = None
        self._is_gone = False
        # File locks work between processes; this lock works between the threads of this process.
        self._lock = threading.Lock()

    def __del__(self) -> None:
        self._close()

    def release(self) -> None:
        """Close the owner file, which is opened again if it is needed."""
        with self._lock:
            self._close()

    def _close(self) -> None:
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            with contextlib.suppress(OSError):
                os.close(descriptor)

    @classmethod
    def take(cls, path: Path, under: Ownership | None = None) -> Owner:
        """Become the owner; the owner before has lost it.

        Args:
            path: The owner file; it is made if it is missing.
            under: The ownership of what this is a part of; it has to be current.

        Raises:
            OwnershipLostError: Another process has taken `under`.
            CannotRunError: The file cannot be written or locked.
        """
        owner = cls(path, "")
        if under is not None:
            under.check()  # nothing is made in the folder of a sweep that is gone
        with owner._locked(makes=True) as descriptor:
            if under is not None:
                under.check()
            number, _, _ = _read(descriptor).partition(" ")
            # If the line can't be read, epochs begin anew; the random part still distinguishes the owners.
            epoch = int(number) + 1 if number.isdecimal() else 1
            line = f"{epoch} {secrets.token_hex(8)} {os.getpid()} {socket.gethostname()}"
            owner.token = line.encode("ascii", "replace")[: _LINE_BYTES - 1].decode("ascii").strip()
            os.pwrite(descriptor, owner.token.ljust(_LINE_BYTES - 1).encode("ascii") + b"\n", 0)
        return owner

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Hold the lock in the block, so that no other process can become the owner meanwhile; not to be nested.

        Raises:
            OwnershipLostError: Another process has become the owner.
            CannotRunError: The file cannot be locked.
        """
        with self._locked() as descriptor:
            if _read(descriptor) != self.token:
                raise self._lost()
            yield

    def is_current(self) -> bool:
        """Whether no other process has become the owner, as far as can be seen without the lock.

        Raises:
            OSError: The file exists but cannot be read.
        """
        try:
            return _line(self.path) == self.token
        except FileNotFoundError:
            return False

    def check(self) -> None:
        """Raise an error if another process has become the owner.

        Raises:
            OwnershipLostError: Another process has.
        """
        if not self.is_current():
            raise self._lost()

    @contextlib.contextmanager
    def _locked(self, *, makes: bool = False) -> Iterator[int]:
        with self._lock:
            try:
                descriptor = self._in_place(makes=makes)
            except OSError as error:
                # Not to be locked by who can't write.
                self._close()
                if not makes and isinstance(error, FileNotFoundError):
                    # It is not made anew: its folder may be gone, with the whole storage.
                    raise self._lost() from error
                raise CannotRunError(
                    f"{self.path} cannot be written and locked: {error.strerror}.",
                    "Check its permissions, and that the file system of the storage has locks.",
                ) from error
            try:
                yield descriptor
            finally:
                fcntl.flock(descriptor, fcntl.LOCK_UN)

    def _in_place(self, *, makes: bool) -> int:
        """Return the file at the path, open and locked, which may be none for a moment, as its storage may."""
        deadline = time.monotonic() + (0.0 if makes or self._is_gone else _AWAY_S)
        while True:
            try:
                descriptor = self._opened(makes=makes)
                self._wait(descriptor)
                if not self._is_at_path(descriptor):
                    # Somebody removed the folder, or replaced the file, as programs that synchronise folders do. Who
                    # is the owner is in the file that is there now.
                    self._close()
                    descriptor = self._opened(makes=makes)
                    self._wait(descriptor)
            except FileNotFoundError:
                if time.monotonic() >= deadline:
                    self._is_gone = True
                    raise
                time.sleep(0.05)
            else:
                return descriptor

    def _opened(self, *, makes: bool) -> int:
        if self._descriptor is None:
            if makes:
                self.path.parent.mkdir(parents=True, exist_ok=True)
            flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK | (os.O_CREAT if makes else 0)
            self._descriptor = os.open(self.path, flags, 0o666)
        refuse_others(os.fstat(self._descriptor), self.path)
        return self._descriptor

    def _is_at_path(self, descriptor: int) -> bool:
        """Whether an open file is still the one at the path."""
        try:
            return os.path.samestat(os.fstat(descriptor), os.lstat(self.path))
        except FileNotFoundError:
            return False

    def _wait(self, descriptor: int) -> None:
        """Lock the file, which other processes hold only for milliseconds."""
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
                    "(epoch, key, process, machine). That process may be stopped, or may wait for its disk.",
                    "End that process, then resume the sweep.",
                )
            time.sleep(pause_s)
            pause_s = min(0.05, 2 * pause_s)

    def _lost(self) -> OwnershipLostError:
        by = ""
        try:
            by = " ".join(_line(self.path).split()[2:])
        except FileNotFoundError:
            return OwnershipLostError(
                f"{self.path.parent} is gone, or has been taken over by another process.",
                "This one writes nothing there any more.",
            )
        except OSError:
            pass
        return OwnershipLostError(
            f"{self.path.parent} has been taken over by another process" + (f" ({by})." if by else "."),
            "Leave it to that process; this one writes nothing there any more.",
        )


class OwnedFolder(ABC):
    """A folder that only one process at a time writes to: the one that took it last."""

    _owner: Owner | None = None

    @property
    @abstractmethod
    def folder(self) -> Path:
        """Its path."""

    def take(self, under: Ownership | None = None) -> None:
        """Become the process that writes here; see `Owner.take`.

        Raises:
            OwnershipLostError: Another process has taken `under`.
        """
        self._owner = Owner.take(within(self.folder, OWNER), under)

    def owned(self) -> AbstractContextManager[None]:
        """Return the context manager for each write; it does nothing in a process that has not taken the folder.

        Raises:
            OwnershipLostError: Another process has taken it.
        """
        return contextlib.nullcontext() if self._owner is None else self._owner.held()

    def is_lost(self) -> bool:
        """Whether this process has taken the folder, and another one has taken it since."""
        return self._owner is not None and not self._owner.is_current()


def _read(descriptor: int) -> str:
    return os.pread(descriptor, _LINE_BYTES, 0).decode("ascii", "replace").strip()


def _line(path: Path) -> str:
    with open_regular(path) as file:
        return file.read(_LINE_BYTES).decode("ascii", "replace").strip()

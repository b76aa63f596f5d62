"""What the process that holds a sweep's lock knows of the sweep without asking: nobody else writes that meanwhile.

The records of a sweep, of its trials and of its winner are written by the lock's holder alone. What it has read or
written since it has the lock is therefore still so, as long as it is sure of the lock: its latest sign of life is so
young that nobody can have taken the lock yet. Writes depend on none of this: each names the content that it replaces.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from tune_jobs.store import names
from tune_jobs.store.objects.bucket import Found, Listed, Tag
from tune_jobs.store.objects.url import ObjectUrl

_WRITTEN_HERE = ("records/", f"{names.BEST_FOLDER}/", f"{names.REPORT_FOLDER}/")
"""What the lock's holder alone writes below, and lists."""


@dataclass
class _Write:
    """A write that is under way."""

    key: str
    number: int
    tag: Tag | None = None
    """What the content is known by, once it is written."""


class Held:
    """What is known of one sweep since this process has its lock.

    Args:
        is_sure: Whether the lock is this process's without doubt; it asks nobody.
        is_new: Whether nobody has had the lock before, so that nobody has written what its holder alone writes.
    """

    def __init__(self, is_sure: Callable[[], bool], *, is_new: bool = False) -> None:
        self._is_sure, self._pid = is_sure, os.getpid()
        self._lock = threading.Lock()
        self._found: dict[str, Found] = {}
        self._is_new = is_new
        self._listed: dict[str, dict[str, Listed]] = {prefix: {} for prefix in _WRITTEN_HERE} if is_new else {}
        # The number of the newest write by key, and how many writes were begun and have ended.
        self._newest: dict[str, int] = {}
        self._num_begun = self._num_ended = 0
        self._is_alone = True

    @property
    def is_known(self) -> bool:
        """Whether what is known here may be relied on."""
        return self._is_alone and self._is_sure() and os.getpid() == self._pid

    def let_others_write(self) -> None:
        """Rely on nothing any more, as another process writes for this one."""
        self._is_alone = False

    def found(self, key: str) -> Found | None:
        """Return an object as it is; None: it has to be asked for."""
        return self._found.get(key) if self.is_known else None

    def is_absent(self, key: str) -> bool:
        """Whether there is no such object, without doubt; only of those that the lock's holder alone writes."""
        with self._lock:
            return self._is_new and self.is_known and key not in self._newest

    def listed(self, prefix: str) -> dict[str, Listed] | None:
        """Return the objects of a listing as they are, by key; None: they have to be asked for."""
        with self._lock:
            known = self._listed.get(prefix) if self.is_known else None
            return None if known is None else dict(known)

    def mark(self) -> int | None:
        """Return what `note` and `note_listed` are given if the store is asked now; None: nothing is noted of it."""
        with self._lock:
            return self._num_begun if self.is_known and self._num_begun == self._num_ended else None

    def forget(self, key: str) -> None:
        """Forget an object that was removed."""
        write = self.begin(key)
        with self._lock:
            self._num_ended += 1
            if self._newest[key] == write.number:
                for listed in self._listed.values():
                    listed.pop(key, None)

    def note(self, key: str, found: Found, mark: int | None) -> None:
        """Note an answer, if nothing was written while it was on its way."""
        with self._lock:
            if mark is not None and mark == self._num_begun:
                self._found[key] = found

    def note_listed(self, prefix: str, listed: dict[str, Listed], mark: int | None) -> None:
        """Note a listing, if nothing was written while it was on its way."""
        with self._lock:
            if mark is not None and mark == self._num_begun:
                self._listed[prefix] = dict(listed)

    @contextlib.contextmanager
    def writing(self, key: str, data: bytes) -> Iterator[_Write]:
        """Write in the block, whose write says then what the content is known by."""
        write = self.begin(key)
        try:
            yield write
        finally:
            self.end(write, data, write.tag)

    def begin(self, key: str) -> _Write:
        """Begin a write, whose writer knows the content that it replaces."""
        with self._lock:
            self._num_begun += 1
            self._newest[key] = self._num_begun
            self._found.pop(key, None)
            return _Write(key, self._num_begun)

    def end(self, write: _Write, data: bytes | None, tag: Tag | None, size: int = 0) -> None:
        """End a write.

        Args:
            write: What `begin` has returned.
            data: The content; None: it is not kept.
            tag: What it is known by now; None: whether it was written is not known.
            size: The number of bytes of a content that is not kept.
        """
        key = write.key
        with self._lock:
            self._num_ended += 1
            is_newest = tag is not None and self._newest[key] == write.number
            if is_newest and tag is not None and data is not None:
                self._found[key] = Found(data, tag)
            for prefix in [prefix for prefix in self._listed if key.startswith(prefix)]:
                if is_newest and tag is not None:
                    self._listed[prefix][key] = Listed(key, size if data is None else len(data), tag, time.time())
                else:
                    del self._listed[prefix]


_held: dict[str, Held] = {}


@contextlib.contextmanager
def holding(url: ObjectUrl, is_sure: Callable[[], bool], *, is_new: bool = False) -> Iterator[None]:
    """Know in the block what lies at an address, whose lock this process has taken; see `Held`."""
    _held[str(url)] = known = Held(is_sure, is_new=is_new)
    try:
        yield
    finally:
        if _held.get(str(url)) is known:
            del _held[str(url)]


def held(url: ObjectUrl) -> Held | None:
    """Return what is known of a sweep whose lock a part of this process holds; None: it holds none."""
    return _held.get(str(url)) if _held else None

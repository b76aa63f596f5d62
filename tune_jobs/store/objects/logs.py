"""Bring logs to the store while they grow: the last part of each, every few seconds, and when a trial ends.

A process that is killed has uploaded all but what it printed last; on its own machine the whole log is still there.
"""

from __future__ import annotations

import contextlib
import os
import threading
import weakref
from pathlib import Path
from typing import TYPE_CHECKING

from policies.errors import TuneJobsError
from policies.files import open_regular

if TYPE_CHECKING:
    from tune_jobs.store.objects.parts import Parts

_EVERY_S = 5.0
_MOST_BYTES = 2**20
"""Of a longer log, the end is kept in the store."""


class LogUploads:
    """Uploads one log, as long as this object exists.

    Args:
        parts: The sweep's objects.
        key: The log's.
        path: The local file.
    """

    def __init__(self, parts: Parts, key: str, path: Path) -> None:
        self._parts, self._key, self._path = parts, key, path
        self._uploaded: tuple[int, int] | None = None
        self._lock = threading.Lock()
        _watch(self)

    def now(self) -> None:
        """Upload the log if it has grown; what cannot be uploaded is tried again later."""
        with contextlib.suppress(OSError, TuneJobsError):
            self.bring()

    def bring(self) -> None:
        """Upload the log if it has grown.

        Raises:
            OSError: It cannot be read.
            StorageError: It cannot be written.
        """
        with self._lock:
            found = self._path.stat()
            state = found.st_size, found.st_mtime_ns
            if state != self._uploaded:
                with open_regular(self._path) as file:
                    file.seek(max(0, found.st_size - _MOST_BYTES))
                    self._parts.bucket.put(self._key, file.read())
                self._uploaded = state


_watched: weakref.WeakSet[LogUploads] = weakref.WeakSet()
_watching: dict[int, threading.Thread] = {}
_beginning = threading.Lock()


def _watch(log: LogUploads) -> None:
    with _beginning:
        _watched.add(log)
        pid = os.getpid()
        if pid not in _watching:
            _watching[pid] = threading.Thread(target=_upload_all, name="logs", daemon=True)
            _watching[pid].start()


def _upload_all() -> None:
    pause = threading.Event()
    while not pause.wait(_EVERY_S):
        with _beginning:
            logs = list(_watched)
        for log in logs:
            log.now()

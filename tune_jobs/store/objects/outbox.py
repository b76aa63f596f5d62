"""Upload in the background: what trains never waits for the store, and whoever has to know waits until it is there.

Of several uploads of one thing, the newest is made. A store that is away for a while is asked again and again; an error
that does not pass is raised at the next write of that thing, or by whoever waits for it.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import threading
import time
from collections.abc import Callable, Collection, Hashable
from dataclasses import dataclass, field

from policies.errors import CannotRunError, TuneJobsError
from tune_jobs.store.objects.bucket import StorageError

_NUM_THREADS = 8
PATIENCE_S = 600.0
"""Seconds for which a store that is away is asked again."""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 15.0
_AT_EXIT_S = 30.0


@dataclass
class _Upload:
    do: Callable[[], None]
    due: float
    failing_since: float | None = None
    pause_s: float = field(default=_FIRST_PAUSE_S)


class Outbox:
    """The uploads of one process."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: dict[Hashable, _Upload] = {}
        self._running: set[Hashable] = set()
        self._failed: dict[Hashable, TuneJobsError] = {}
        self._num_threads = 0

    def add(self, key: Hashable, do: Callable[[], None], *, after_s: float = 0.0) -> None:
        """Have something uploaded; an upload of the same key that has not begun is left out.

        Args:
            key: What it is an upload of; those of one key are made one after the other.
            do: Uploads it. It is called again if it raises a `StorageError` that may pass.
            after_s: Seconds in which another one may come, which is made instead.

        Raises:
            TuneJobsError: An earlier upload of the key has failed.
        """
        with self._changed:
            self._raise_failed([key])
            known = self._waiting.get(key)
            due = time.monotonic() + after_s
            if known is None:
                self._waiting[key] = _Upload(do, due)
            else:
                known.do, known.due = do, min(known.due, due) if known.failing_since is None else known.due
            if self._num_threads < min(_NUM_THREADS, len(self._waiting) + len(self._running)):
                self._num_threads += 1
                threading.Thread(target=self._work, name="uploads", daemon=True).start()
            self._changed.notify_all()

    def settle(self, keys: Collection[Hashable] | None = None, timeout_s: float = PATIENCE_S + 60.0) -> None:
        """Wait until what was added is uploaded.

        Args:
            keys: Of which it is waited for; None: of all.
            timeout_s: Seconds to wait at most.

        Raises:
            TuneJobsError: An upload has failed.
            CannotRunError: The store has been away too long.
        """
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while True:
                wanted = set(self._waiting) | self._running if keys is None else {*keys}
                left = [key for key in wanted if key in self._waiting or key in self._running]
                for key in left:
                    upload = self._waiting.get(key)
                    if upload is not None and upload.failing_since is None:
                        upload.due = 0.0
                if not left:
                    self._raise_failed(self._failed if keys is None else wanted)
                    return
                self._changed.notify_all()
                if time.monotonic() > deadline:
                    raise CannotRunError(
                        f"{len(left)} uploads have not ended within {timeout_s:.0f} s.",
                        "Check that the storage is reached from this machine.",
                    )
                self._changed.wait(min(1.0, max(0.01, deadline - time.monotonic())))

    def forget(self, keys: Collection[Hashable]) -> None:
        """Leave out uploads that have not begun, and forget what failed; wait for those that have."""
        with self._changed:
            for key in keys:
                self._waiting.pop(key, None)
                while key in self._running:
                    self._changed.wait(1.0)
                self._waiting.pop(key, None)
                self._failed.pop(key, None)

    def _raise_failed(self, keys: Collection[Hashable]) -> None:
        for key in keys:
            if key in self._failed:
                raise self._failed[key]

    def _work(self) -> None:
        while True:
            with self._changed:
                found = self._next()
                while found is None:
                    self._changed.wait(self._pause_s())
                    found = self._next()
                key, upload = found
            error: TuneJobsError | None = None
            try:
                upload.do()
            except TuneJobsError as raised:
                error = raised
            except Exception as raised:  # noqa: BLE001 (told to whoever waits)
                error = CannotRunError(f"An upload of {key} failed: {type(raised).__name__}: {raised}.")
                error.__cause__ = raised
            with self._changed:
                self._running.discard(key)
                if error is not None:
                    self._note(key, upload, error)
                self._changed.notify_all()

    def _note(self, key: Hashable, upload: _Upload, error: TuneJobsError) -> None:
        now = time.monotonic()
        since = now if upload.failing_since is None else upload.failing_since
        if not (isinstance(error, StorageError) and error.passes) or now - since > PATIENCE_S:
            self._waiting.pop(key, None)
            self._failed[key] = error
            return
        newer = self._waiting.get(key)
        again = newer if newer is not None else upload
        again.failing_since, again.due = since, now + upload.pause_s
        again.pause_s = min(_LONGEST_PAUSE_S, 2 * upload.pause_s)
        self._waiting[key] = again

    def _next(self) -> tuple[Hashable, _Upload] | None:
        now = time.monotonic()
        for key, upload in self._waiting.items():
            if upload.due <= now and key not in self._running:
                del self._waiting[key]
                self._running.add(key)
                return key, upload
        return None

    def _pause_s(self) -> float:
        due = min((upload.due for key, upload in self._waiting.items() if key not in self._running), default=None)
        return 60.0 if due is None else min(60.0, max(0.01, due - time.monotonic()))


_outboxes: dict[int, Outbox] = {}


def outbox() -> Outbox:
    """Return this process's; a forked one has its own."""
    pid = os.getpid()
    if pid not in _outboxes:
        _outboxes.clear()
        _outboxes[pid] = Outbox()
        atexit.register(_settle_at_exit, pid)
    return _outboxes[pid]


def _settle_at_exit(pid: int) -> None:
    if os.getpid() == pid and pid in _outboxes:
        with contextlib.suppress(TuneJobsError):
            _outboxes[pid].settle(timeout_s=_AT_EXIT_S)

"""Upload in the background: what trains never waits for the store, and whoever has to know waits until it is there.

Of several uploads of one thing, the newest is made. A store that is away for a while is asked again and again; an error
that does not pass is raised at the next write of that thing, or by whoever waits for it.
"""

from __future__ import annotations

import atexit
import heapq
import itertools
import logging
import os
import threading
import time
from collections.abc import Callable, Collection, Hashable
from dataclasses import dataclass, field

from policies.errors import CannotRunError, TuneJobsError
from tune_jobs.store.objects.bucket import StorageError
from tune_jobs.store.objects.scratch import own_folder

_LOG = logging.getLogger(__name__)
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
    pause_s: float = field(default_factory=lambda: _FIRST_PAUSE_S)
    error: TuneJobsError | None = None
    """Why it failed last."""


class Outbox:
    """The uploads of one process; thousands may wait, so nothing here looks through all of them for one."""

    def __init__(self) -> None:
        lock = threading.RLock()
        self._added, self._ended = threading.Condition(lock), threading.Condition(lock)
        self._waiting: dict[Hashable, _Upload] = {}
        # By the time they are due; what has been begun or left out since, or is due at another time, is passed over.
        self._queue: list[tuple[float, int, Hashable]] = []
        self._numbers = itertools.count()
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
        with self._added:
            self._raise_failed([key])
            due = time.monotonic() + after_s
            known = self._waiting.get(key)
            if known is None:
                self._wait(key, _Upload(do, due))
            else:
                known.do = do
                if due < known.due and known.failing_since is None:
                    self._hasten(key, known, due)
            if self._num_threads < min(_NUM_THREADS, len(self._waiting) + len(self._running)):
                self._num_threads += 1
                threading.Thread(target=self._work, name="uploads", daemon=True).start()

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
        with self._added:
            wanted = {*self._waiting, *self._running, *self._failed} if keys is None else {*keys}
            left = list(wanted)
            for key in left:
                self._hurry(key)
            while left:
                if not self._is_under_way(left[-1]):
                    left.pop()
                    continue
                if time.monotonic() > deadline:
                    raise self._not_settled([key for key in left if self._is_under_way(key)], timeout_s)
                # Another one of the same key may have come.
                self._hurry(left[-1])
                self._ended.wait(min(1.0, max(0.01, deadline - time.monotonic())))
            self._raise_failed(wanted)

    def _not_settled(self, left: Collection[Hashable], timeout_s: float) -> CannotRunError:
        errors = [upload.error for key in left if (upload := self._waiting.get(key)) is not None and upload.error]
        why = f" {errors[0].message}" if errors else ""
        hint = errors[0].hint if errors else "Check that the storage is reached from this machine."
        passes = any(isinstance(error, StorageError) and error.passes for error in errors)
        return StorageError(f"{len(left)} uploads have not ended within {timeout_s:.0f} s.{why}", hint, passes=passes)

    def forget(self, keys: Collection[Hashable]) -> None:
        """Leave out uploads that have not begun, and forget what failed; wait for those that have."""
        with self._added:
            for key in list(keys):
                self._waiting.pop(key, None)
                while key in self._running:
                    self._ended.wait(1.0)
                self._waiting.pop(key, None)
                self._failed.pop(key, None)

    def _raise_failed(self, keys: Collection[Hashable]) -> None:
        for key in keys:
            if key in self._failed:
                error = self._failed[key]
                raise error.again() from error

    def _is_under_way(self, key: Hashable) -> bool:
        return key in self._waiting or key in self._running

    def _wait(self, key: Hashable, upload: _Upload) -> None:
        self._waiting[key] = upload
        self._hasten(key, upload, upload.due)

    def _hasten(self, key: Hashable, upload: _Upload, due: float) -> None:
        upload.due = due
        # The threads wait for what is due first; one of them is told only of what is due before that.
        is_first = not self._queue or due < self._queue[0][0]
        heapq.heappush(self._queue, (due, next(self._numbers), key))
        if is_first:
            self._added.notify()

    def _hurry(self, key: Hashable) -> None:
        upload = self._waiting.get(key)
        if upload is not None and upload.failing_since is None and upload.due:
            self._hasten(key, upload, 0.0)

    def _work(self) -> None:
        while True:
            with self._added:
                found = self._next()
                while found is None:
                    self._added.wait(max(0.001, self._queue[0][0] - time.monotonic()) if self._queue else 60.0)
                    found = self._next()
                key, upload = found
                if self._queue:
                    # For what is due next, while this one is busy.
                    self._added.notify()
            error: TuneJobsError | None = None
            try:
                upload.do()
            except TuneJobsError as raised:
                error = raised
            except Exception as raised:  # noqa: BLE001 (told to whoever waits)
                error = CannotRunError(f"An upload of {key} failed: {type(raised).__name__}: {raised}.")
                error.__cause__ = raised
            with self._added:
                self._running.discard(key)
                if error is not None:
                    self._note(key, upload, error)
                elif key in self._waiting:
                    # It was passed over while this one ran.
                    self._hasten(key, self._waiting[key], self._waiting[key].due)
                self._ended.notify_all()

    def _note(self, key: Hashable, upload: _Upload, error: TuneJobsError) -> None:
        now = time.monotonic()
        since = now if upload.failing_since is None else upload.failing_since
        if not (isinstance(error, StorageError) and error.passes) or now - since > PATIENCE_S:
            self._waiting.pop(key, None)
            self._failed[key] = error
            return
        again = self._waiting.get(key, upload)
        again.failing_since, again.due, again.error = since, now + upload.pause_s, error
        again.pause_s = min(_LONGEST_PAUSE_S, 2 * upload.pause_s)
        self._wait(key, again)

    def _next(self) -> tuple[Hashable, _Upload] | None:
        now = time.monotonic()
        while self._queue and self._queue[0][0] <= now:
            due, _, key = heapq.heappop(self._queue)
            upload = self._waiting.get(key)
            if upload is not None and upload.due == due and key not in self._running:
                del self._waiting[key]
                self._running.add(key)
                return key, upload
        return None


_outboxes: dict[int, Outbox] = {}


def outbox() -> Outbox:
    """Return this process's; a forked one has its own."""
    pid = os.getpid()
    if pid not in _outboxes:
        _outboxes.clear()
        _outboxes[pid] = Outbox()
        # What is uploaded lies there: the folder is made before, so that it is removed after the last upload.
        own_folder()
        atexit.register(_settle_at_exit, pid)
    return _outboxes[pid]


def _settle_at_exit(pid: int) -> None:
    if os.getpid() == pid and pid in _outboxes:
        try:
            _outboxes[pid].settle(timeout_s=_AT_EXIT_S)
        except TuneJobsError as error:
            _LOG.warning("This process ends, and not all that it wrote is in the store: %s", error.message)

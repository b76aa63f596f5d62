"""Follow sweeps for clients: one thread for each sweep that somebody watches, however many do."""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import threading
import time
from collections.abc import Iterator

from policies.errors import CannotRunError, CheckpointError, NotFoundError
from tune_jobs.service.busy import BusyError, held
from tune_jobs.service.ending import tell_left
from tune_jobs.service.event_log import EventLog
from tune_jobs.service.labels import Labels
from tune_jobs.service.queue import Queue
from tune_jobs.service.statuses import Statuses
from tune_jobs.service.views import ListView, SweepView, View
from tune_jobs.store.contract import Storage
from tune_jobs.store.patience import impatient
from tune_jobs.sweeps.curves import Columns

_log = logging.getLogger(__name__)

LINGER_S = 30.0
"""How long something is followed when nobody watches it any more: whoever comes back finds what came meanwhile."""
AWAITED_S = 300.0
"""How long it is followed for whoever has asked for its curves and does not watch yet: they load its trials meanwhile,
of which there may be many and the way long, and without what came since they would have to begin anew."""
MOST_UNWATCHED = 32
"""How many are followed that nobody watches."""
_END_S = 2.0
"""How long all that follow are waited for as they end: sweeps save after that, and a silent database holds a look."""
_MOST_WAIT_S = 5.0
_SHARE = 0.05
"""The share of a core that following one thing takes, unless it would be too old then."""
_FOR_EACH_S = 0.01
"""By so much each client that watches lets them all wait longer, in seconds: to send to each takes its time, too."""


class Follower:
    """Asks a view again and again, in a thread of its own, and logs what has changed.

    Args:
        what: What is followed, for messages.
        view: It.
        log: The events.
    """

    def __init__(self, what: str, view: View, log: EventLog) -> None:
        self.what, self._view, self.log = what, view, log
        self.used_at = time.monotonic()
        self._awaited_until = self.used_at
        self._looking = threading.Lock()
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def begin(self) -> None:
        """Look once, and go on in the thread; who comes meanwhile waits, and later calls do nothing.

        Raises:
            NotFoundError: There is nothing to be followed.
            BusyError: Somebody else looks, and is not to be waited for.
        """
        self.used_at = time.monotonic()
        if self._thread is not None:
            return
        with held(self._looking):
            if self._thread is None:
                with impatient():
                    self.log.add(self._view.changes())
                # The first look at a large sweep may take longer than one lingers.
                self.used_at = time.monotonic()
                thread = threading.Thread(target=self._run, name=f"watch {self.what}", daemon=True)
                # Another thread, which closes all, may join it as soon as it is known.
                thread.start()
                self._thread = thread

    def end(self) -> None:
        """Let the thread and the log end; may be called more than once."""
        self._over.set()
        self.log.end()

    def join(self, limit_s: float | None = None) -> bool:
        """Wait for the end of the thread, at most so long; return whether it has come."""
        if self._thread is not None:
            self._thread.join(limit_s)
        return self._thread is None or not self._thread.is_alive()

    @property
    def is_watched(self) -> bool:
        """Whether somebody watches."""
        return self.log.num_listeners > 0

    def curves(self, most: int) -> tuple[str, dict[str, Columns]]:
        """Return the id of the last event and, of a sweep, the curves as of then: at most so many points a trial.

        Raises:
            BusyError: Somebody else looks, and is not to be waited for.
        """
        with held(self._looking):
            curves = self._view.curves.columns(most) if isinstance(self._view, SweepView) else {}
            self._awaited_until = time.monotonic() + AWAITED_S
            return self.log.last_id, curves

    def _run(self) -> None:
        wait_s, has_failed = self._view.interval_s, False
        while not self._over.wait(wait_s):
            began = time.monotonic()
            if self.is_watched:
                self.used_at = self._awaited_until = began
            elif began > max(self.used_at + LINGER_S, self._awaited_until):
                break
            try:
                with self._looking, impatient():
                    changes = self._view.changes()
                    # A look that failed may have taken changes with it.
                    self.log.add([*changes, ("reset", {})] if has_failed else changes)
            except NotFoundError as error:
                if not isinstance(error, CheckpointError):
                    self.log.add([("deleted", {})])
                    break
                _log.warning("%s can't be followed just now: %s", self.what, error)
                wait_s, has_failed = _MOST_WAIT_S, True
            except CannotRunError as error:
                _log.warning("%s can't be followed just now: %s", self.what, error)
                wait_s, has_failed = _MOST_WAIT_S, True
            except Exception:  # noqa: BLE001 (such as a database that is away for a while)
                _log.exception("%s could not be looked at; it is tried again.", self.what)
                wait_s, has_failed = _MOST_WAIT_S, True
            else:
                has_failed = False
                least_s = max(self._view.interval_s, self.log.num_listeners * _FOR_EACH_S)
                wait_s = min(_MOST_WAIT_S, max(least_s, (time.monotonic() - began) / _SHARE))
        self.end()


class Watching:
    """What is watched; threads may share it.

    Args:
        storage: The sweeps.
        statuses: What they look like.
        queue: The jobs.
        labels: What people say of sweeps.
        max_watchers: How many clients may watch at once.
    """

    def __init__(self, storage: Storage, statuses: Statuses, queue: Queue, labels: Labels, max_watchers: int) -> None:
        self._storage, self._statuses, self._queue, self._labels = storage, statuses, queue, labels
        # Numbers of events begin anew with the service: this tells whose they are.
        self._start, self._numbers = f"{time.time_ns():x}{os.getpid():x}", itertools.count(1)
        self.max_watchers = max_watchers
        self._num_watchers = 0
        self._watches: dict[str | None, Follower] = {}
        self._lock = threading.Lock()
        self._is_closed = False

    def sweep(self, name: str) -> Follower:
        """Return what follows a sweep.

        Raises:
            NotFoundError: There is none, or it is damaged.
        """
        return self._watch(name)

    def sweeps(self) -> Follower:
        """Return what follows the list of sweeps."""
        return self._watch(None)

    @contextlib.contextmanager
    def place(self) -> Iterator[bool]:
        """Take the place of a client for the block; gives whether there was one."""
        with self._lock:
            is_free = self._num_watchers < self.max_watchers
            self._num_watchers += is_free
        try:
            yield is_free
        finally:
            with self._lock:
                self._num_watchers -= is_free

    @property
    def num_watchers(self) -> int:
        """How many clients watch."""
        return self._num_watchers

    def close(self) -> None:
        """End all streams, and those that come later at once; what still looks after a moment is left to itself."""
        with self._lock:
            self._is_closed = True
            watches = list(self._watches.values())
        for watch in watches:
            watch.end()
        deadline = time.monotonic() + _END_S
        left = [watch.what for watch in watches if not watch.join(max(0.0, deadline - time.monotonic()))]
        if left:
            tell_left([f"looks at {what}" for what in left], _END_S)

    def _watch(self, name: str | None) -> Follower:
        with self._lock:
            watch = self._watches.get(name)
            if watch is None or watch.log.has_ended:
                self._make_room()
                watch = self._watches[name] = self._made(name)
                if self._is_closed:
                    watch.end()
        try:
            watch.begin()
        except BusyError:
            # Somebody looks, and what they follow is followed.
            raise
        except BaseException:
            with self._lock:
                if self._watches.get(name) is watch:
                    del self._watches[name]
            raise
        return watch

    def _made(self, name: str | None) -> Follower:
        if name is None:
            whole = ListView(self._statuses, self._queue, self._labels)
            return Follower("the list of sweeps", whole, EventLog(self._start, self._numbers))
        view = SweepView(name, self._storage, self._statuses, self._queue, self._labels)
        return Follower(f"sweep {name}", view, EventLog(self._start, self._numbers, greeting=view.greeting))

    def _make_room(self) -> None:
        """End those that nobody has watched for the longest, and forget those that have ended."""
        self._watches = {name: watch for name, watch in self._watches.items() if not watch.log.has_ended}
        unwatched = sorted((item for item in self._watches.items() if not item[1].is_watched), key=_last_used)
        for name, watch in unwatched[: max(0, len(unwatched) - MOST_UNWATCHED + 1)]:
            watch.end()
            del self._watches[name]


def _last_used(item: tuple[str | None, Follower]) -> float:
    return item[1].used_at

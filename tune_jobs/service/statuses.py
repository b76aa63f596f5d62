"""What sweeps look like just now, without reading thousands of files for each request."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

from analysis.records import TrialRecord
from policies.errors import NotFoundError, TuneJobsError
from tune_jobs.store.candidates import leave_out
from tune_jobs.store.contract import Storage, Sweep
from tune_jobs.sweeps.status import SweepStatus, status_of

FRESH_S = 0.5
"""How old what is told of a running sweep may be."""


@dataclass(frozen=True)
class Seen:
    """A sweep as it was at some time."""

    status: SweepStatus
    trials: tuple[TrialRecord, ...]
    at: float
    """A monotonic time, in seconds."""
    stamp: tuple[int, ...]
    """Of the sweep's record; another one means another record."""

    @property
    def is_over(self) -> bool:
        """Whether nothing changes unless the record does."""
        return not self.status.alive and self.status.sweep.state != "running"


class Statuses:
    """The sweeps of a storage; threads may share one.

    Args:
        storage: The sweeps.
    """

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._seen: dict[str, Seen] = {}
        self._locks: dict[str, threading.Lock] = {}
        self._lock = threading.Lock()

    def see(self, name: str) -> Seen:
        """Return a sweep as it is, or was a moment ago.

        Raises:
            NotFoundError: There is none, or it is damaged.
        """
        sweep = self._storage.sweep(name)
        with self._lock:
            lock = self._locks.setdefault(name, threading.Lock())
        # Of many that ask at once, one reads.
        with lock:
            stamp = sweep.record_stamp()
            known = self._seen.get(name)
            if known is not None and known.stamp == stamp and self._holds(known, sweep):
                return known
            if not sweep.exists():
                self.forget(name)
                raise NotFoundError(f"There is no sweep {name[:80]!r}.", "List the sweeps with `tune-jobs list`.")
            trials = sweep.read_trials()
            seen = Seen(status_of(sweep, trials), tuple(trials), time.monotonic(), stamp)
            self._seen[name] = seen
            return seen

    def _holds(self, known: Seen, sweep: Sweep) -> bool:
        if known.is_over:
            # A driver that begins takes the lock before it writes anything.
            return not sweep.is_driven()
        return time.monotonic() - known.at < FRESH_S

    def all(self) -> list[Seen]:
        """Return all sweeps, by name; those that can't be read give a warning."""
        found = []
        for sweep in self._storage.sweeps():
            try:
                found.append(self.see(sweep.name))
            except TuneJobsError as error:
                leave_out(error)
        return found

    def forget(self, name: str) -> None:
        """Forget a sweep that is no more."""
        self._seen.pop(name, None)
        with self._lock:
            self._locks.pop(name, None)

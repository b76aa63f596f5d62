"""The records of a run's trials: kept in memory, told to a listener at once, written to disk when it is worth it."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

from analysis.records import TrialRecord
from policies.envs.tallies import Reached, read_tally
from tune_jobs.store import transitions
from tune_jobs.store.contract import Ownership, Sweep
from tune_jobs.store.event_files import ScalarWriter
from tune_jobs.store.progress import Progress

Listener = Callable[[TrialRecord], None]
Change = Callable[[TrialRecord], TrialRecord]
"""What becomes of a trial's record; see `transitions`."""

# A record is synced to disk, which takes about a millisecond: those of running trials are not written more often.
_WRITES_PER_S = 20.0


class RecordKeeper:
    """Turns what becomes of trials into their records.

    That a trial runs no more is written by the next `flush`; of those that run it writes as many as it has time for.

    Args:
        store: The sweep.
        trial_ids: The trials of this run.
        listener: Called with a trial's record whenever it changes.
        clock: Seconds, monotonic.
        run: The run whose trials they are; what a run writes that has been taken up by another is an
            `OwnershipLostError`. None: nobody else can run the sweep.
    """

    def __init__(
        self,
        store: Sweep,
        trial_ids: Sequence[str],
        listener: Listener,
        clock: Callable[[], float] = time.monotonic,
        run: Ownership | None = None,
    ) -> None:
        self._store = store
        self._run = run
        self._records = {name: store.trial(name).read_record() for name in trial_ids}
        self._others = [record for record in store.read_trials() if record.trial_id not in self._records]
        self._listener = listener
        self._clock = clock
        self._scalars = ScalarWriter(store)
        # Trials whose record on disk is not the newest, and when it was written.
        self._changed: set[str] = set()
        self._written_at: dict[str, float] = {}
        self._num_writes_due, self._flushed_at = _WRITES_PER_S, clock()
        self.running: set[str] = set()
        """Trials that a process has."""

    def __getstate__(self) -> dict[str, Any]:
        # Tune pickles who drives it into a file that is never read back here; listeners and open files can't be.
        return {}

    def owned(self) -> AbstractContextManager[None]:
        """What is entered around each write of the process that drives the sweep.

        Raises:
            OwnershipLostError: Another process runs the sweep by now.
        """
        return contextlib.nullcontext() if self._run is None else self._run.held()

    def record(self, trial_id: str) -> TrialRecord:
        """A trial's newest record."""
        return self._records[trial_id]

    def all_records(self) -> list[TrialRecord]:
        """The newest record of every trial of the sweep, those of earlier runs too."""
        return sorted([*self._others, *self._records.values()], key=lambda record: record.index)

    def change(self, trial_id: str, change: Change) -> None:
        """Change a trial's record, on disk at once: for what its process reads."""
        self._update(trial_id, change(self._records[trial_id]))
        self._write(trial_id)

    def started(self, trial_id: str) -> None:
        """A process took the trial."""
        self.running.add(trial_id)
        self._update(trial_id, transitions.begun(self._records[trial_id], time.time()))

    def progressed(self, trial_id: str, progress: Progress, *, node: str, pid: int) -> None:
        """A trial told where it stands."""
        if progress.status != "running":
            self.running.discard(trial_id)
        record = transitions.told(self._records[trial_id], progress, node=node, pid=pid)
        self._update(trial_id, record)
        self._scalars.write(record, evaluated=progress.evaluated)

    def paused(self, trial_id: str) -> None:
        """A trial was paused that did not tell so itself; it goes on from its latest checkpoint."""
        self.running.discard(trial_id)
        self._update(trial_id, transitions.paused(self._records[trial_id]))

    def lost(self, trial_id: str) -> None:
        """A trial's process ended because another one has the trial, which waits to be continued."""
        self.paused(trial_id)

    def ended(self, trial_id: str) -> None:
        """A trial runs no more: by itself, as it has told, or it was paused or stopped."""
        self.running.discard(trial_id)
        self._forget_tally(trial_id)
        record = self._records[trial_id]
        if record.status not in ("running", "paused"):
            return
        if self._store.stop_requested():
            self._update(trial_id, transitions.paused(record))
        else:
            self._update(trial_id, transitions.stopped(record, time.time()))

    def failed(self, trial_id: str, error: str, *, retried: bool, reached: Reached | None = None) -> None:
        """A trial failed, for good or to be tried again.

        Args:
            trial_id: The trial.
            error: Why; of a long one the middle is left out.
            retried: Whether it is tried again.
            reached: How far it was; None: what its process has left behind says so.
        """
        self.running.discard(trial_id)
        if reached is None:
            reached = read_tally(self._store.trial(trial_id).tally_path)
        record = self._records[trial_id]
        self._update(trial_id, transitions.failed(record, error, time.time(), retried=retried, reached=reached))
        if not retried:
            self._forget_tally(trial_id)

    def _forget_tally(self, trial_id: str) -> None:
        """What is in a process's tally is in the record now, or its trial is over."""
        self._store.trial(trial_id).forget_tally()

    def flush(self) -> None:
        """Write what is due: first what was written longest ago."""
        self._write_scalars()
        now = self._clock()
        self._num_writes_due = min(_WRITES_PER_S, self._num_writes_due + (now - self._flushed_at) * _WRITES_PER_S)
        self._flushed_at = now
        for trial_id in sorted(self._changed, key=lambda name: (self._written_at.get(name, -math.inf), name)):
            if self._records[trial_id].status != "running":
                self._write(trial_id)
            elif self._num_writes_due >= 1:
                self._num_writes_due -= 1
                self._write(trial_id)

    def close(self) -> None:
        """Write everything; nothing becomes of any trial any more."""
        for trial_id in sorted(self._changed):
            self._write(trial_id)
        self._write_scalars()

    def _write_scalars(self) -> None:
        with self.owned():
            self._scalars.flush()

    def _update(self, trial_id: str, record: TrialRecord) -> None:
        self._records[trial_id] = record
        self._changed.add(trial_id)
        self._listener(record)

    def _write(self, trial_id: str) -> None:
        record = self._records[trial_id]
        with self.owned():
            self._store.trial(trial_id).write_record(record)
        self._written_at[trial_id] = self._clock()
        self._changed.discard(trial_id)

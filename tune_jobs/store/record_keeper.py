"""Keep the records of a run's trials in memory, pass changes to a listener, and write them to disk when due."""

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
"""A function that changes a trial's record; see `transitions`."""

# Syncing a record to disk takes about a millisecond, so those of running trials are not written more often.
_WRITES_PER_S = 20.0


class RecordKeeper:
    """Updates the records of trials by what happens to them.

    The next `flush` writes the records of all trials that have stopped running, and as many others as it has time for.

    Args:
        store: The sweep.
        trial_ids: The trials of this run.
        listener: Called with a trial's record whenever it changes.
        clock: A monotonic clock, in seconds.
        run: The ownership of the run; if another run has taken over, writes raise `OwnershipLostError`. None: no
            other process can run the sweep.
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
        known = {record.trial_id: record for record in store.read_trials()}
        self._records = {name: known.get(name) or store.trial(name).read_record() for name in trial_ids}
        self._others = [record for name, record in known.items() if name not in self._records]
        self._listener = listener
        self._clock = clock
        self._scalars = ScalarWriter(store)
        # Trials whose record on disk is not the newest, and when it was last written.
        self._changed: set[str] = set()
        self._written_at: dict[str, float] = {}
        self._num_writes_due, self._flushed_at = _WRITES_PER_S, clock()
        self.running: set[str] = set()
        """The trials that a process runs."""
        self._has_left_one = False
        """Whether a trial has saved and left because somebody asked for the end."""

    def __getstate__(self) -> dict[str, Any]:
        # Tune pickles this object into a file that is never read back; listeners and open files can't be pickled.
        return {}

    def owned(self) -> AbstractContextManager[None]:
        """Return the context manager for each write of the process that drives the sweep.

        Raises:
            OwnershipLostError: Another process runs the sweep by now.
        """
        return contextlib.nullcontext() if self._run is None else self._run.held()

    def record(self, trial_id: str) -> TrialRecord:
        """Return a trial's newest record."""
        return self._records[trial_id]

    def all_records(self) -> list[TrialRecord]:
        """Return the newest record of every trial of the sweep, including those of earlier runs."""
        return sorted([*self._others, *self._records.values()], key=lambda record: record.index)

    def change(self, trial_id: str, change: Change) -> None:
        """Change a trial's record, and write it at once, because the trial's process reads it."""
        self._update(trial_id, change(self._records[trial_id]))
        self._write(trial_id)
        self._store.settle()

    def started(self, trial_id: str) -> None:
        """Note that a process has begun a trial."""
        self.running.add(trial_id)
        self._update(trial_id, transitions.begun(self._records[trial_id], time.time()))

    def progressed(self, trial_id: str, progress: Progress, *, node: str, pid: int) -> None:
        """Take a trial's progress."""
        if progress.status != "running":
            self.running.discard(trial_id)
        if progress.status == "paused":
            self._has_left_one = True
        record = transitions.told(self._records[trial_id], progress, node=node, pid=pid)
        self._update(trial_id, record)
        self._scalars.write(record, progress.iterations)

    def paused(self, trial_id: str) -> None:
        """Note that a trial was paused without a report; it will continue from its latest checkpoint."""
        self.running.discard(trial_id)
        self._update(trial_id, transitions.paused(self._records[trial_id]))

    def lost(self, trial_id: str) -> None:
        """Note that a trial's process ended because another one has taken the trial, which waits to be continued."""
        self.paused(trial_id)

    def moved(self, trial_id: str, left: str) -> None:
        """Note that a trial's node is gone; the trial has not failed, and goes on elsewhere.

        Args:
            trial_id: The trial.
            left: What became of the node, a sentence.
        """
        self.running.discard(trial_id)
        note = f"{left} The trial went on elsewhere, from its latest checkpoint."
        self._update(trial_id, transitions.moved(self._records[trial_id], note))

    def ended(self, trial_id: str) -> None:
        """Note that a trial runs no more: it has ended by itself, or it was paused or stopped."""
        self.running.discard(trial_id)
        self._forget_tally(trial_id)
        record = self._records[trial_id]
        if record.status not in ("running", "paused"):
            return
        if self.stop_requested():
            self._update(trial_id, transitions.paused(record))
        else:
            self._update(trial_id, transitions.stopped(record, time.time()))

    def stop_requested(self) -> bool:
        """Whether somebody has asked for the end of the run, as far as this process or one that trains knows.

        What the store answers may be some seconds old, and another process may have heard a newer answer: trials that
        leave for that are not to be taken for ended by a scheduler, and nobody gets their places.
        """
        return self._has_left_one or self._store.stop_requested()

    def failed(self, trial_id: str, error: str, *, retried: bool, reached: Reached | None = None) -> None:
        """Note that a trial failed, finally or to be retried.

        Args:
            trial_id: The trial.
            error: Why it failed; the middle of a long text is left out.
            retried: Whether it is retried.
            reached: How far it had come; None: this is read from what its process has left behind.
        """
        self.running.discard(trial_id)
        if reached is None:
            reached = read_tally(self._store.trial(trial_id).tally_path)
        record = self._records[trial_id]
        self._update(trial_id, transitions.failed(record, error, time.time(), retried=retried, reached=reached))
        if not retried:
            self._forget_tally(trial_id)

    def _forget_tally(self, trial_id: str) -> None:
        """Delete a trial's tally, because its numbers are in the record now, or the trial is over."""
        self._store.trial(trial_id).forget_tally()

    def flush(self) -> None:
        """Write the records that are due, beginning with those that were written longest ago."""
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
        """Write everything; nothing may be noted afterwards."""
        for trial_id in sorted(self._changed):
            self._write(trial_id)
        self._write_scalars()
        self._store.settle()

    def _write_scalars(self) -> None:
        if self._scalars.has_any:
            with self.owned():
                self._scalars.flush()

    def _update(self, trial_id: str, record: TrialRecord) -> None:
        self._records[trial_id] = record
        self._changed.add(trial_id)
        self._listener(record)

    def _write(self, trial_id: str) -> None:
        record = self._records[trial_id]
        with self.owned():
            self._store.trial(trial_id).write_record(record, soon=True)
        self._written_at[trial_id] = self._clock()
        self._changed.discard(trial_id)

"""What sweeps look like just now, without reading thousands of files for each request.

A trial's record is read again only when it was written; and what takes long, such as to sum up ten thousand trials, is
done less often.
"""

from __future__ import annotations

import contextvars
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

from analysis.records import TrialRecord
from analysis.selection import score_trial
from policies.envs.tallies import Reached
from policies.errors import CheckpointError, NotFoundError, TuneJobsError
from tune_jobs.service.folder_names import check_text
from tune_jobs.service.storage_health import is_of_store
from tune_jobs.store.candidates import leave_out, some_trials
from tune_jobs.store.contract import Storage, Sweep
from tune_jobs.store.objects.at_once import AT_ONCE
from tune_jobs.store.patience import impatient
from tune_jobs.store.urls import is_url
from tune_jobs.sweeps.reached import as_reached, reached_by_now
from tune_jobs.sweeps.status import SweepStatus, as_left, status_of, was_killed

FRESH_S = 0.4
"""How old what is told of a running sweep may be; of one with thousands of trials it may be older."""
_OLDEST_LOOK_S, _OLDEST_STATUS_S, _OLDEST_WINNER_S = 2.0, 5.0, 5.0
_SILENCE_S = 5.0
"""How long no trial of a sweep is written until it is looked for how far they are within an iteration."""
_SHARE = 0.02
"""The share of a core that following one sweep takes, unless it would be too old then."""


@dataclass(frozen=True)
class Done:
    """When something was done, and how long it took; monotonic seconds."""

    at: float
    took_s: float

    def is_due(self, now: float, oldest_s: float) -> bool:
        """Whether it is time to do it again."""
        return now - self.at >= min(oldest_s, max(FRESH_S, self.took_s / _SHARE))


@dataclass(frozen=True)
class Trials:
    """The trials of a sweep as they were at some time."""

    records: tuple[TrialRecord, ...]
    """By index; a record that has not changed meanwhile is the object that it was."""
    scores: Mapping[str, float | None]
    """The score of each by its id, None if it can't win."""
    stamps: Mapping[str, tuple[int, ...]]


@dataclass(frozen=True)
class Seen:
    """A sweep as it was at some time; status and trials are the objects that they were if nothing has changed."""

    status: SweepStatus
    trials: Trials
    """Its trials, those that run with what they have trained since they were written, where that is long ago.

    Those that ran when its process was killed are paused."""
    written: Trials
    """Its trials as their records have them."""
    written_at: float
    """When it was noticed that a record was written; monotonic seconds."""
    reached: Mapping[str, Reached]
    """How far running trials are within their iterations, by their ids, as far as it was looked for."""
    was_killed: bool
    """Whether its process was killed before it could write which trials it left."""
    stamp: tuple[int, ...]
    """Of the sweep's record; another one means another record."""
    best_stamp: tuple[int, ...]
    """Of the winner that the status has."""
    looked: Done
    summed_up: Done
    of: Trials
    """What the status was made of, which may be older than `trials`."""

    @property
    def name(self) -> str:
        """The sweep's name."""
        return self.status.sweep.name

    @property
    def is_over(self) -> bool:
        """Whether nothing changes unless the record does, or the winner."""
        return not self.status.alive and self.status.sweep.state != "running"

    def is_due(self, now: float) -> bool:
        """Whether it is time to look again, though the record is the same."""
        return now - self.looked.at >= _OLDEST_WINNER_S if self.is_over else self.looked.is_due(now, _OLDEST_LOOK_S)


class Statuses:
    """The sweeps of a storage; threads may share one.

    Args:
        storage: The sweeps.
        clock: A monotonic clock, in seconds.
    """

    def __init__(self, storage: Storage, clock: Callable[[], float] = time.monotonic) -> None:
        self._storage, self._clock = storage, clock
        self._seen: dict[str, Seen] = {}
        self._locks: dict[str, threading.Lock] = {}
        self._lock = threading.Lock()
        # Not those for single requests: who looks at a sweep may wait for another who does, and makes such requests.
        self._looking = ThreadPoolExecutor(AT_ONCE, "statuses")

    def see(self, name: str) -> Seen:
        """Return a sweep as it is, or was a moment ago.

        Raises:
            NotFoundError: There is none, it is damaged, or its name is nothing that JSON and addresses can have.
            CannotRunError: Its store does not answer, or its lock cannot be read.
        """
        # Whoever asks for it holds the lock meanwhile, and the next one waits for that.
        with impatient():
            return self._see(name)

    def _see(self, name: str) -> Seen:
        check_text(name)
        sweep = self._storage.sweep(name)
        with self._lock:
            lock = self._locks.setdefault(name, threading.Lock())
        # Of many that ask at once, one reads.
        with lock:
            stamp, known = sweep.record_stamp(), self._seen.get(name)
            if known is not None and known.stamp == stamp and known.status.alive == sweep.is_driven():
                now = self._clock()
                if not known.is_due(now):
                    return known
                # `tune-jobs best` chooses anew for a sweep that is over, and changes no record.
                is_same = not known.is_over or known.best_stamp == sweep.best_stamp()
                if known.is_over and is_same:
                    known = self._seen[name] = replace(known, looked=Done(now, 0.0))
                    return known
            else:
                # It began or ended, or nobody has asked for it yet: the status has to be of now.
                is_same = False
            if not sweep.exists():
                self.forget(name)
                raise NotFoundError(f"There is no sweep {name[:80]!r}.", "List the sweeps with `tune-jobs list`.")
            seen = self._seen[name] = self._look(sweep, stamp, known, is_same=is_same)
            return seen

    def _look(self, sweep: Sweep, stamp: tuple[int, ...], known: Seen | None, *, is_same: bool) -> Seen:
        began = self._clock()
        record, stamps = sweep.read_record(), sweep.trial_stamps()
        if record.name != sweep.name:
            # Somebody has renamed its folder: by that name it is listed and asked for.
            record = record.model_copy(update={"name": sweep.name})
        alive = sweep.is_driven()
        killed = was_killed(record, alive=alive)
        written, trials, written_at, reached = self._trials(sweep, stamps, known, is_driven=alive, killed=killed)
        now = self._clock()
        # To read all of them is not what it takes to follow them.
        looked = Done(now, 0.0 if known is None else now - began)
        if known is not None and is_same and (known.of is trials or not known.summed_up.is_due(now, _OLDEST_STATUS_S)):
            return replace(
                known, trials=trials, written=written, written_at=written_at, reached=reached, was_killed=killed,
                looked=looked,
            )  # fmt: skip
        # Before the winner is read: a later one has another stamp.
        best_stamp = sweep.best_stamp()
        status = status_of(sweep, record, trials.records, alive=alive)
        summed_up = Done(self._clock(), self._clock() - now)
        return Seen(
            status, trials, written, written_at, reached, killed, stamp, best_stamp, looked, summed_up, of=trials
        )

    def _trials(
        self,
        sweep: Sweep,
        stamps: Mapping[str, tuple[int, ...]],
        known: Seen | None,
        *,
        is_driven: bool,
        killed: bool,
    ) -> tuple[Trials, Trials, float, Mapping[str, Reached]]:
        """Return the trials as they were written, as they are now, when one was written, and how far they are."""
        now = self._clock()
        if known is None:
            written = _read(sweep, stamps, None)
            return written, _told(written, {}, killed=killed), now, {}
        reached = known.reached if is_driven else {}
        if known.written.stamps != stamps:
            written = _read(sweep, stamps, known.written)
            # One that was written may go on from an earlier checkpoint.
            before = {id(record) for record in known.written.records}
            names = {record.trial_id for record in written.records if id(record) in before}
            reached = {name: each for name, each in reached.items() if name in names}
            return written, _told(written, reached, killed=killed), now, reached
        if is_driven and now - known.written_at >= _SILENCE_S:
            reached = reached_by_now(sweep, known.written.records)
        is_same = reached == known.reached and killed == known.was_killed
        trials = known.trials if is_same else _told(known.written, reached, killed=killed)
        return known.written, trials, known.written_at, reached

    def all(self) -> list[Seen]:
        """Return all sweeps, by name; those that can't be read give a warning.

        Raises:
            CheckpointError: They can't be listed.
            CannotRunError: Their store does not answer.
        """
        with impatient():
            names = [sweep.name for sweep in self._storage.sweeps()]
        return [seen for seen in self._each(names) if seen is not None]

    def _each(self, names: Sequence[str]) -> Iterable[Seen | None]:
        """Look at several sweeps; at those of an object store side by side, as each look waits for answers."""
        if not is_url(self._storage.place):
            return map(self._readable, names)
        contexts = [contextvars.copy_context() for _ in names]
        return self._looking.map(lambda context, name: context.run(self._readable, name), contexts, names)

    def _readable(self, name: str) -> Seen | None:
        """Return a sweep as `see` does; None, with a warning: it can't be read."""
        try:
            return self.see(name)
        except TuneJobsError as error:
            if is_of_store(self._storage, error):
                # Without those that it has, a list would say that they are gone.
                raise
            leave_out(error)
            return None

    def forget(self, name: str) -> None:
        """Forget a sweep that is no more."""
        self._seen.pop(name, None)
        with self._lock:
            self._locks.pop(name, None)


def _told(written: Trials, reached: Mapping[str, Reached], *, killed: bool) -> Trials:
    """Return the trials with what some have trained since they were written, or as a killed process left them."""
    if killed:
        return replace(written, records=tuple(as_left(written.records)))
    if not reached:
        return written
    records = tuple(as_reached(record, reached.get(record.trial_id)) for record in written.records)
    return replace(written, records=records)


def _read(sweep: Sweep, stamps: Mapping[str, tuple[int, ...]], known: Trials | None) -> Trials:
    """Read the records that were written since, and take the others as they were."""
    before = Trials((), {}, {}) if known is None else known
    same = {trial_id for trial_id, stamp in stamps.items() if before.stamps.get(trial_id) == stamp}
    # One that was damaged, and still is, is in neither.
    records = [record for record in before.records if record.trial_id in same]
    scores = {record.trial_id: before.scores[record.trial_id] for record in records}
    for trial_id, record in some_trials(sweep, [name for name in stamps if name not in same]).items():
        if isinstance(record, CheckpointError):
            leave_out(record)
            continue
        records.append(record)
        scored = score_trial(record)
        scores[trial_id] = None if scored is None else scored.score
    return Trials(tuple(sorted(records, key=lambda record: record.index)), scores, stamps)

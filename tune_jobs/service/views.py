"""What can be followed: a sweep, and the list of sweeps. Each says what has changed since it was asked last."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol, TypeVar

from tune_jobs.service.jobs import Job
from tune_jobs.service.labels import NOTHING, Labels
from tune_jobs.service.queue import Queue
from tune_jobs.service.statuses import Seen, Statuses, Trials
from tune_jobs.service.summaries import SweepSummary, jobs_by_sweep, summary, trial_row
from tune_jobs.store.contract import Storage
from tune_jobs.sweeps.curves import Curves

Change = tuple[str, Mapping[str, Any]]
"""The kind of an event, and its data."""

_ItemT = TypeVar("_ItemT")
_AT_ONCE = 200
"""Trials of one event; a client that reads slowly gets the first of thousands while others are made."""


class View(Protocol):
    """Something that is followed."""

    interval_s: float
    """How often it may be asked."""

    def changes(self) -> list[Change]:
        """Return the events since the last call.

        Raises:
            NotFoundError: It is no more.
        """
        ...


class SweepView:
    """A sweep.

    Its events: `status`, a sweep as in the list; `job`, one of its jobs; `trials`, records of trials that have changed;
    `iterations`, new points of their curves.

    Args:
        name: The sweep.
        storage: The sweeps.
        statuses: What they look like.
        queue: The jobs.
        labels: What people say of sweeps.
    """

    interval_s = 0.5
    greeting = ("status", "job")

    def __init__(self, name: str, storage: Storage, statuses: Statuses, queue: Queue, labels: Labels) -> None:
        self._name, self._statuses, self._queue, self._labels = name, statuses, queue, labels
        self.curves = Curves(storage.sweep(name))
        self._summary: SweepSummary | None = None
        self._trials: Trials | None = None
        self._jobs: dict[int, Job] = {}

    def changes(self) -> list[Change]:
        """Return the events since the last call; the first one gives no trials and iterations, which are many."""
        seen, is_first = self._statuses.see(self._name), self._trials is None
        changed = self._changed_trials(seen)
        # The others have nobody who writes their results.
        written = {record.trial_id for record in changed}
        written |= {record.trial_id for record in seen.trials.records if record.status == "running"}
        rows = self.curves.update(sorted(written))
        found: list[Change] = [*self._new_jobs(seen.status.sweep.created_at)]
        if not is_first:
            scores = seen.trials.scores
            found += [
                ("trials", {"trials": [trial_row(record, scores[record.trial_id]) for record in some]})
                for some in _parts(changed)
            ]
            found += [("iterations", {"trials": dict(some)}) for some in _parts(list(rows.items()))]
        now = summary(seen, self._labels.of(self._name), jobs_by_sweep(self._jobs.values()).get(self._name))
        if now != self._summary:
            self._summary = now
            found.append(("status", now.model_dump(mode="json")))
        return found

    def _changed_trials(self, seen: Seen) -> Sequence[Any]:
        before = {} if self._trials is None else {record.trial_id: record for record in self._trials.records}
        if self._trials is seen.trials:
            return ()
        self._trials = seen.trials
        return [record for record in seen.trials.records if before.get(record.trial_id) is not record]

    def _new_jobs(self, created_at: float) -> Iterator[Change]:
        jobs = {job.id: job for job in self._queue.jobs(sweep=self._name) if not job.is_of_former(created_at)}
        before, self._jobs = self._jobs, jobs
        for job in jobs.values():
            if before.get(job.id) != job:
                yield "job", job.model_dump(mode="json")


class ListView:
    """The list of sweeps.

    Its events: `sweeps`, those that have changed or are new; `deleted`, the names of those that are gone.

    Args:
        statuses: What sweeps look like.
        queue: The jobs.
        labels: What people say of sweeps.
    """

    interval_s = 1.0
    greeting = ()

    def __init__(self, statuses: Statuses, queue: Queue, labels: Labels) -> None:
        self._statuses, self._queue, self._labels = statuses, queue, labels
        self._known: dict[str, SweepSummary] | None = None

    def changes(self) -> list[Change]:
        """Return the events since the last call; the first one gives none."""
        labels, jobs = self._labels.all(), jobs_by_sweep(self._queue.jobs())
        now = {
            seen.name: summary(seen, labels.get(seen.name, NOTHING), jobs.get(seen.name))
            for seen in self._statuses.all()
        }
        before, self._known = self._known, now
        if before is None:
            return []
        changed = [item.model_dump(mode="json") for name, item in now.items() if before.get(name) != item]
        found: list[Change] = [("sweeps", {"sweeps": list(some)}) for some in _parts(changed)]
        gone = sorted(before.keys() - now.keys())
        return [*found, ("deleted", {"names": gone})] if gone else found


def _parts(items: Sequence[_ItemT]) -> Iterator[Sequence[_ItemT]]:
    return (items[begin : begin + _AT_ONCE] for begin in range(0, len(items), _AT_ONCE))

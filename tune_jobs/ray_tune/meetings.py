"""Let members of packs wait for each other where their scheduler compares them, in whichever packs they are.

From `due_at` on, a member is saved at its next evaluation and is trained no further: it *arrives*. When all arrive that
it is to be compared with, the outcomes say what becomes of each. Nothing here depends on which of them was faster.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

from analysis.records import FINISHED, TrialRecord
from policies.errors import CheckpointError
from tune_jobs.ray_tune.hyperband import HyperBand
from tune_jobs.ray_tune.population import Change, Population, take_over
from tune_jobs.ray_tune.scheduling import CopyFrom, Decision, NobodyWaits, Scheduler, Standing
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.contract import Assignment, Sweep

_LOG = logging.getLogger(__name__)

Outcome = Decision | CopyFrom


class Meeting(Scheduler, Protocol):
    """A scheduler for members of packs that wait for each other. All trials begin before any other call."""

    def begin(self, records: Sequence[TrialRecord], todo: Collection[str]) -> None:
        """Add the trials of a run, in the order of the records.

        Args:
            records: The trials, and those that ended before this run and were compared with them; see `compared_with`.
            todo: The ids of the trials.
        """
        ...

    def due_at(self, trial_id: str) -> int | None:
        """Return the env steps from which a trial waits, at its next evaluation; None: it waits no more."""
        ...

    def arrives(self, standing: Standing) -> None:
        """Take a trial that is saved and waits; it may be told again."""
        ...

    def leaves(self, trial_id: str) -> None:
        """Note that a trial does not wait any more, as its process has ended: it will arrive again."""
        ...

    def gone(self, trial_id: str) -> None:
        """Take a trial out that has ended, in whatever way; nobody waits for it any longer."""
        ...

    def take_outcomes(self) -> dict[str, Outcome]:
        """Return what becomes of those that waited, each once: it goes on, ends, or goes on from another's copy."""
        ...


def compared_with(
    trial_ids: Collection[str], records: Sequence[TrialRecord], seeds_per_point: int
) -> list[TrialRecord]:
    """Return the records of trials of a run, and of those that ended before it and were compared with them.

    Args:
        trial_ids: The trials.
        records: Of all trials of the sweep, in their order, which is that of what is returned.
        seeds_per_point: The seeds of a point that are trained for the search; nobody compares further ones.
    """
    engines = {record.engine for record in records if record.trial_id in trial_ids}
    return [
        record
        for record in records
        if record.trial_id in trial_ids
        or (record.status in FINISHED and record.engine in engines and record.seed_index < seeds_per_point)
    ]


def meeting_of(scheduler: Scheduler) -> Meeting | None:
    """Return the meeting of a scheduler whose trials wait for each other in packs; None: its trials don't."""
    if isinstance(scheduler, Population):
        return PopulationMeeting(scheduler)
    if isinstance(scheduler, HyperBand):
        return HyperBandMeeting(scheduler)
    return None


def assignment_of(records: Sequence[TrialRecord], num_failures: dict[str, int], meeting: Meeting | None) -> Assignment:
    """Return what a pack is told of its trials: with a meeting, where each waits, and how often it was changed.

    Args:
        records: The trials, in their order in the pack.
        num_failures: How often each has failed; those that have not are left out.
        meeting: Where they wait for each other; None: nowhere.
    """
    trial_ids = tuple(record.trial_id for record in records)
    if meeting is None:
        return Assignment(trial_ids, num_failures)
    due = {trial_id: meeting.due_at(trial_id) for trial_id in trial_ids}
    return Assignment(
        trial_ids,
        num_failures,
        {trial_id: steps for trial_id, steps in due.items() if steps is not None},
        {record.trial_id: len(record.changes) for record in records if record.changes},
    )


def goes_on_from(outcome: CopyFrom, spec: SweepSpec, store: Sweep, record: TrialRecord, change: Change) -> None:
    """Let a trial go on from another's copy, see `take_over`; as it is, where there is nothing to copy."""
    try:
        take_over(spec, store, record, outcome, change)
    except CheckpointError as error:
        _LOG.warning("%s goes on as it is: %s", record.trial_id, error)


@dataclass(frozen=True)
class _Ended:
    """The other trials of a population that is compared as a whole; implements `Others`."""

    names: Collection[str]

    def wait(self) -> bool:
        """Return False: whoever waits for a place gets that of one that has arrived."""
        return False

    def ended(self) -> Collection[str]:
        """Return the trials that have ended in this run."""
        return self.names


class PopulationMeeting:
    """All trials of a population that have not ended are compared at once, when the last of them has arrived.

    They are compared in the order in which they began. With Ray Tune's trials, each is compared as soon as it gets
    there, with what the others had reached at their last comparisons.
    """

    def __init__(self, population: Population) -> None:
        self._population = population
        self._has_met = False
        self._live: dict[str, Standing | None] = {}
        """The trials that have not ended, in the order in which they began; None: it has not arrived."""
        self._gone: set[str] = set()

    def begin(self, records: Sequence[TrialRecord], todo: Collection[str]) -> None:
        """Add the trials of a run; whoever has ended is compared no more."""
        for record in records:
            if record.trial_id in todo:
                self.begins(record.trial_id)

    def begins(self, trial_id: str) -> None:
        """Add a trial to the population."""
        self._population.begins(trial_id)
        self._live[trial_id] = None

    def due_at(self, trial_id: str) -> int:
        """Return the end of the present interval."""
        if not self._has_met:
            # All have begun now, so it is known who of a resumed sweep is ahead of the others.
            self._has_met = True
            self._population.in_step()
        return self._population.due_at(trial_id)

    def reached(self, standing: Standing, others: object) -> Decision:  # noqa: ARG002 (it is compared where it waits)
        """Let a trial go on that has not come to its comparison yet."""
        return Decision.GO_ON

    def arrives(self, standing: Standing) -> None:
        """Take a trial that waits for its comparison."""
        self._live[standing.trial_id] = standing

    def leaves(self, trial_id: str) -> None:
        """Wait for a trial again."""
        if trial_id in self._live:
            self._live[trial_id] = None

    def ended(self, standing: Standing) -> None:
        """Take a trial out."""
        self.gone(standing.trial_id)

    def gone(self, trial_id: str) -> None:
        """Take a trial out, however it ended."""
        self._live.pop(trial_id, None)
        self._gone.add(trial_id)

    def take_outcomes(self) -> dict[str, Outcome]:
        """Compare the trials if all of them have arrived."""
        standings = [standing for standing in self._live.values() if standing is not None]
        if len(standings) < len(self._live) or not standings:
            return {}
        self._live = dict.fromkeys(self._live)
        return self._population.compared(standings, _Ended(self._gone))


class HyperBandMeeting:
    """The trials of a bracket wait at its milestones; see `HyperBand`."""

    def __init__(self, band: HyperBand) -> None:
        self._band = band
        self._waiting: dict[str, None] = {}
        self._outcomes: dict[str, Outcome] = {}

    def begin(self, records: Sequence[TrialRecord], todo: Collection[str]) -> None:
        """Give the trials of a run the places in brackets that they have among all of the search."""
        self._band.begin(records, todo)

    def begins(self, trial_id: str) -> None:
        """Give a trial a place in a bracket."""
        self._band.begins(trial_id)

    def due_at(self, trial_id: str) -> int | None:
        """Return the next milestone of a trial's bracket."""
        return self._band.next_milestone(trial_id)

    def reached(self, standing: Standing, others: object) -> Decision:  # noqa: ARG002 (the band knows the others)
        """Decide about a trial between two milestones: one without a score ends after the grace period."""
        return self._band.reached(standing, NobodyWaits())

    def arrives(self, standing: Standing) -> None:
        """Take a trial that is at a milestone."""
        decision = self._band.reached(standing, NobodyWaits())
        if decision is Decision.WAIT:
            self._waiting[standing.trial_id] = None
        else:
            self._waiting.pop(standing.trial_id, None)
            self._outcomes[standing.trial_id] = decision
            if decision is Decision.STOP:
                self._band.gone(standing.trial_id)

    def leaves(self, trial_id: str) -> None:
        """Forget that a trial waits; it will arrive again, unless it is decided about before."""
        self._waiting.pop(trial_id, None)

    def ended(self, standing: Standing) -> None:
        """Take a trial out."""
        self.gone(standing.trial_id)

    def gone(self, trial_id: str) -> None:
        """Take a trial out, however it ended; the others may be due now."""
        self._waiting.pop(trial_id, None)
        self._outcomes.pop(trial_id, None)
        self._band.gone(trial_id)

    def take_outcomes(self) -> dict[str, Outcome]:
        """Return who goes on beyond a milestone, and who ends there."""
        for trial_id in self._band.take_ended():
            self._waiting.pop(trial_id, None)
            self._outcomes[trial_id] = Decision.STOP
        for trial_id in [name for name in self._waiting if not self._band.waits(name)]:
            del self._waiting[trial_id]
            self._outcomes[trial_id] = Decision.GO_ON
        outcomes, self._outcomes = self._outcomes, {}
        return outcomes

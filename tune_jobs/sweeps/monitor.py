"""Sum up a running sweep: the numbers of the live table, without the table."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from analysis.records import FINISHED, TrialRecord, TrialStatus
from analysis.selection import NoUsableTrialError, Selection, select_best
from policies.envs.tallies import Reached
from tune_jobs.sweeps.forecast import Forecast, forecast
from tune_jobs.sweeps.reached import as_reached

_RATE_WINDOW_S = 20.0
_IDLE_S = 10.0
"""How long no trial runs until that is worth a word; from one trial to the next takes less."""
_SILENCE_S = 5.0
"""How long no trial reports until it is looked for how far they are within an iteration."""
_LOOK_S = 1.0


@dataclass(frozen=True)
class Row:
    """A trial in the live table."""

    rank: int | None
    """The rank of its point, from 1; None: it has no score yet."""
    score: float | None
    trial: TrialRecord


class SweepMonitor:
    """Takes trial records when they change, and sums them up.

    Args:
        name: The sweep's name.
        records: Its trials at the start.
        caps: The env steps after which each trial ends at the latest, by its id.
        reached: Returns how far a running trial is at this moment, by its id; None: it is not known.
        clock: A monotonic clock, in seconds.
    """

    def __init__(
        self,
        name: str,
        records: Iterable[TrialRecord],
        *,
        caps: Mapping[str, int],
        reached: Callable[[str], Reached | None] = lambda _: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name = name
        self.records: dict[str, TrialRecord] = {record.trial_id: record for record in records}
        self.stopping = False
        """Whether somebody has asked the trials to stop."""
        self.is_over = False
        """Whether nothing follows any more: neither what is done now nor how long it takes is told."""
        self.stage = ""
        self.phase = ""
        """What is done before the trials train or after they have, such as "starting Ray"; empty while they do."""
        self.reported_at: float | None = None
        """When a trial last reported env steps, Unix time in seconds; None: none has."""
        self._caps = caps
        self._clock = clock
        self._start = self._looked_at = self._heard_at = clock()
        self._reached = reached
        self._within: dict[str, Reached] = {}
        """How far trials are that have not told it yet, by their ids."""
        # When the last trial that ran ended or was lost.
        self._idle_since = self._start
        self._num_env_steps = sum(record.num_env_steps for record in self.records.values())
        self._history: deque[tuple[float, int]] = deque([(self._start, self._num_env_steps)])
        self._selection: Selection | None = None
        # It needs all records; with a thousand trials, that takes too long to do at every report.
        self._selection_is_old = True

    def begin_stage(self, told: str, records: Iterable[TrialRecord], caps: Mapping[str, int]) -> None:
        """Take the trials of a further stage of the same run.

        Args:
            told: What they are for; it is shown behind the sweep's name.
            records: All trials of the sweep.
            caps: As for a new monitor.
        """
        self.stage = told
        self._idle_since = self._clock()
        # The caps come first: a table that is drawn meanwhile asks for that of each record.
        self._caps = caps
        self.records = {record.trial_id: record for record in records}
        self._num_env_steps = sum(record.num_env_steps for record in self.records.values())
        self._selection_is_old = True

    @property
    def title(self) -> str:
        """The sweep's name, and what its present trials are for."""
        return f"{self.name}, {self.stage}" if self.stage else self.name

    @property
    def elapsed_s(self) -> float:
        """Seconds since this monitor was made."""
        return self._clock() - self._start

    @property
    def num_env_steps(self) -> int:
        """Env steps of all trials so far."""
        return self._num_env_steps

    @property
    def waits(self) -> bool:
        """Whether trials are left and none has run for a while: no node has room for one, or none is there."""
        if self.phase or self.stopping or self.is_over or self._clock() - self._idle_since < _IDLE_S:
            return False
        statuses = {record.status for record in list(self.records.values())}
        return "running" not in statuses and not statuses <= FINISHED

    def progress(self) -> Forecast:
        """Return how far the trials are, in env steps, and how long the others take: what `status` tells, too."""
        records = list(self.records.values())
        # Of ten thousand trials that report, a look at each would be for nothing.
        return forecast([self._as_reached(record) for record in records] if self._within else records, self._caps)

    def end(self) -> None:
        """Tell only what came of it from now on."""
        self.phase, self.stopping, self.is_over = "", False, True

    def look(self) -> None:
        """Look how far the trials are if none has reported for a while: an iteration of a slow env takes minutes."""
        now = self._clock()
        if now - self._heard_at < _SILENCE_S or now - self._looked_at < _LOOK_S:
            return
        self._looked_at = now
        running = [name for name, record in list(self.records.items()) if record.status == "running"]
        self._within = {name: reached for name in running if (reached := self._reached(name)) is not None}

    def _as_reached(self, record: TrialRecord) -> TrialRecord:
        """Return a trial's record with what the trial has reached since it was written."""
        return as_reached(record, self._within.get(record.trial_id))

    def update(self, record: TrialRecord) -> None:
        """Take the new state of a trial."""
        if record.status == "running":
            self.phase = ""
        before = self.records.get(record.trial_id)
        if before is None or record.num_env_steps > before.num_env_steps:
            self.reported_at = time.time()
        if before is not None and before.status == "running":
            self._idle_since = self._clock()
        looked_up = self._within.get(record.trial_id)
        if looked_up is not None and (
            looked_up.num_env_steps <= record.num_env_steps
            # It goes on from an earlier checkpoint.
            or (before is not None and record.num_env_steps < before.num_env_steps)
        ):
            # Whoever draws may have looked again meanwhile.
            self._within.pop(record.trial_id, None)
        self._num_env_steps += record.num_env_steps - (before.num_env_steps if before else 0)
        self.records[record.trial_id] = record
        self._heard_at = now = self._clock()
        if self._num_env_steps == self._history[0][1]:
            # Nothing was sampled here before: the time to start Ray and the processes must not count for the rate.
            self._history.clear()
        self._history.append((now, self._num_env_steps))
        while len(self._history) > 2 and self._history[1][0] < now - _RATE_WINDOW_S:
            self._history.popleft()
        seen = None if before is None else (before.status, before.best_evaluation_return)
        if seen != (record.status, record.best_evaluation_return):
            self._selection_is_old = True

    def counts(self) -> dict[TrialStatus, int]:
        """Return the number of trials by status."""
        return dict(Counter(record.status for record in self.records.values()))

    @property
    def num_evaluating(self) -> int:
        """How many of the running trials play an evaluation, as far as was looked for."""
        evaluating = [self.records.get(name) for name, each in list(self._within.items()) if each.evaluates]
        # Of a sweep that is only shown, a record that was damaged meanwhile is left out.
        return sum(record is not None and record.status == "running" for record in evaluating)

    def best(self) -> Selection | None:
        """Return the winner so far, by the rule that will choose the winner; None while no trial is usable."""
        if self._selection_is_old:
            self._selection_is_old = False
            try:
                self._selection = select_best(list(self.records.values()))
            except NoUsableTrialError:
                self._selection = None
        return self._selection

    def rows(self, most: int) -> tuple[list[Row], int]:
        """Return the trials that matter now: the leader, those that run, and the best of the others.

        Args:
            most: How many at most, one or more.

        Returns:
            The trials by rank, those without a score last; and the number of running ones that are left out.
        """
        best = self.best()
        ranked = [] if best is None else self._ranked(best)
        known = {row.trial.trial_id for row in ranked}
        new = [
            Row(None, None, self._as_reached(record))
            for record in list(self.records.values())
            if record.status == "running" and record.trial_id not in known
        ]
        rows = [*ranked, *sorted(new, key=lambda row: (-row.trial.num_env_steps, row.trial.index))]
        # The first is the leader. Sorting keeps the order by rank among those that are as important.
        by_worth = sorted(rows[1:], key=lambda row: row.trial.status != "running")
        shown = {row.trial.trial_id for row in [*rows[:1], *by_worth][:most]}
        left_out = sum(row.trial.status == "running" and row.trial.trial_id not in shown for row in rows)
        return [row for row in rows if row.trial.trial_id in shown], left_out

    def _ranked(self, best: Selection) -> list[Row]:
        return [
            # The selection may be older than the newest report of its trials.
            Row(rank, scored.score, self._as_reached(self.records[scored.trial.trial_id]))
            for rank, point in enumerate(best.ranking, start=1)
            for scored in point.trial_scores
        ]

    def env_steps_per_s(self) -> float | None:
        """Return the env steps of all trials a second, over the last seconds; None: there were none."""
        first_time, first_steps = self._history[0]
        span = self._clock() - first_time
        return (self._num_env_steps - first_steps) / span if span > 0 and self._num_env_steps > first_steps else None

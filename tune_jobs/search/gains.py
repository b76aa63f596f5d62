"""What the intervals of a population's trials have gained, by their records and results alone."""

from __future__ import annotations

import itertools
import logging
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from analysis.records import TrialRecord
from policies.errors import CheckpointError
from tune_jobs.search.bandit import Gain
from tune_jobs.store.contract import Sweep
from tune_jobs.store.results_tail import ResultsMark

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Score:
    """An evaluation of a trial."""

    iteration: int
    num_env_steps: int
    value: float


Curves = Mapping[str, Sequence[Score]]
"""Evaluations by trial, in their order."""


class Evaluations:
    """Reads the evaluations of trials, each iteration once.

    Args:
        store: The sweep.
    """

    def __init__(self, store: Sweep) -> None:
        self._store = store
        self._known: dict[str, tuple[ResultsMark, tuple[Score, ...]]] = {}

    def __call__(self, trial_ids: Sequence[str]) -> dict[str, tuple[Score, ...]]:
        """Return the evaluations of some trials; of one whose results can't be read now, those that were read."""
        return {trial_id: self._of(trial_id) for trial_id in trial_ids}

    def _of(self, trial_id: str) -> tuple[Score, ...]:
        mark, scores = self._known.get(trial_id, (ResultsMark(), ()))
        try:
            new = self._store.trial(trial_id).read_new_points(mark)
        except CheckpointError as error:
            _LOG.warning("%s: %s", trial_id, error)
            return scores
        added = tuple(
            Score(point.iteration, point.num_env_steps, point.evaluation_return)
            for point in new.points
            if point.evaluation_return is not None
        )
        self._known[trial_id] = new.mark, added if new.replaced else scores + added
        return self._known[trial_id][1]


def gains_of(records: Sequence[TrialRecord], curves: Curves, interval: int) -> list[Gain]:
    """Return the intervals of all trials, each from one comparison to the next.

    Where an interval begins with a change, it begins at the score of the trial that was copied. A trial's first one
    begins at its first evaluation, and so does one after a copy of a trial whose score is not known.

    Args:
        records: The trials.
        curves: Their evaluations; trials may lack.
        interval: Env steps between two comparisons.
    """
    return [gain for record in records for gain in _of_trial(record, curves, interval)]


def _of_trial(record: TrialRecord, curves: Curves, interval: int) -> list[Gain]:
    changes = {change.iteration: change for change in record.changes}
    until = list(itertools.accumulate((change.iteration for change in record.changes), max))
    """The last iteration that was trained with the point before each change."""
    found: list[Gain] = []
    begin: tuple[int, float] | None = None
    """Env steps and score at the interval's beginning; None: not known yet."""
    due = interval
    for score in curves.get(record.trial_id, ()):
        change = changes.get(score.iteration)
        if score.num_env_steps >= due or change is not None:
            if begin is not None and score.num_env_steps > begin[0]:
                steps, before = begin
                length = (score.num_env_steps - steps) / interval
                place = bisect_left(until, score.iteration)
                point = record.changes[place].before if place < len(until) else record.point
                time = score.num_env_steps / interval
                found.append(Gain(time, before, (score.value - before) / length, point))
            value: float | None = score.value
            if change is not None:
                # The trial's own score is none of the weights that it goes on with.
                value = _score_at(curves.get(change.source_trial_id, ()), change.source_iteration)
            begin = None if value is None else (score.num_env_steps, value)
            due = score.num_env_steps + interval
        elif begin is None:
            begin = score.num_env_steps, score.value
    return found


def _score_at(curve: Sequence[Score], iteration: int) -> float | None:
    """Return a trial's newest score at an iteration; None: it had none."""
    place = bisect_right(curve, iteration, key=lambda score: score.iteration)
    return curve[place - 1].value if place else None

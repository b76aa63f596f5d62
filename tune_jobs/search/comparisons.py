"""Where the trials of a population were compared before a sweep was resumed, by their records and results alone."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from analysis.records import TrialRecord
from policies.errors import CheckpointError
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.contract import Sweep
from tune_jobs.store.results_tail import CurvePoint, ResultsMark

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Comparison:
    """A comparison of a trial with the others."""

    num_env_steps: int
    """The trial's own, then."""
    score: float | None
    """The evaluation return that it was compared by; None: it was not a finite number."""


def comparisons_before(
    store: Sweep, spec: SweepSpec, records: Sequence[TrialRecord]
) -> dict[str, tuple[Comparison, ...]]:
    """Return the comparisons of trials up to now, oldest first; without those whose results are not known.

    Args:
        store: The sweep.
        spec: Its spec.
        records: The trials.
    """
    if all(record.status == "pending" and not record.num_env_steps for record in records):
        return {}  # nothing was trained, and a store that is far away need not be asked for each of them
    found = {}
    with store.reading():
        for record in records:
            try:
                points = store.trial(record.trial_id).read_new_points(ResultsMark()).points
            except CheckpointError as error:
                _LOG.warning("%s: %s", record.trial_id, error)
                continue
            if points:
                found[record.trial_id] = _of_trial(record, points, spec)
    return found


def _of_trial(record: TrialRecord, points: Iterable[CurvePoint], spec: SweepSpec) -> tuple[Comparison, ...]:
    """Return a trial's comparisons: its first evaluations at which an interval was over, each from the one before."""
    interval, every = spec.perturb_every_env_steps, spec.evaluation.every_iterations
    changed = {change.iteration for change in record.changes}
    found, due = list[Comparison](), interval
    for point in points:
        # Results have no return of an evaluation that was not a finite number.
        is_evaluated = point.evaluation_return is not None or point.iteration % every == 0
        if (is_evaluated and point.num_env_steps >= due) or point.iteration in changed:
            found.append(Comparison(point.num_env_steps, point.evaluation_return))
            due = point.num_env_steps + interval
    return tuple(found)


def last_over(places: Iterable[int], interval: int) -> int:
    """Return the last of some env steps at which an interval is over that counts from the one before; 0: none is."""
    last = 0
    for place in places:
        if place >= last + interval:
            last = place
    return last


def made_together(places: Mapping[str, Sequence[int]], changed_at: Mapping[str, int]) -> dict[str, list[int]] | None:
    """Return the comparisons made of trials that are compared all at once; None: some were added behind the others.

    Nobody is trained beyond the next comparison, so as many were made as those have behind them who have the fewest:
    whoever has one more waits there for them. What somebody was changed at was made, though results of others may lack.

    Args:
        places: Env steps of the comparisons of each trial, as far as its results tell them; at least of one trial.
        changed_at: Env steps at which trials were changed last, of those that were.
    """
    numbers = [len(own) for own in places.values()]
    if max(numbers) > min(numbers) + 1:
        return None
    made = max([min(numbers), *(sum(place <= steps for place in places[name]) for name, steps in changed_at.items())])
    last = max((own[made - 1] for own in places.values() if len(own) >= made > 0), default=0)
    return {name: [*own[:made], *[last] * (made - len(own))] for name, own in places.items()}

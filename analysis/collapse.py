"""Which trials collapsed: ended far below what they had learnt.

What a trial has learnt is how far its best evaluation is above where it began: above its first evaluation or its first
training return, whichever is lower. The first evaluation may come when much is learnt already, and early training
returns are those of a policy that explores. It collapsed if by its last evaluation more than half of that gain is lost,
so that the sign and size of returns do not matter. Evaluations of trials that hardly learn go up and down by chance,
and lose half of a small gain easily: a trial that gained less than a fifth of what the one that learnt most did is not
said to have collapsed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from analysis.records import FINISHED, IterationRecord, TrialRecord
from analysis.statistics import has_collapsed
from analysis.wording import counted, range_text

SHARE = 0.5
"""A trial collapsed if its last evaluation lost more than this share of what its best one had gained."""
LEAST_GAIN = 0.2
"""What a trial must have gained to lose, as a share of the largest gain of its sweep."""
COLLAPSE_MEANS = (
    "A trial collapsed if, by its last evaluation, it had lost more than half of what its best one had gained over "
    "where it began: over its first evaluation or its first training return, whichever is lower. Those that gained "
    "less than a fifth of what the best trial did don't count."
)
_MAX_NAMED = 3


@dataclass(frozen=True)
class Collapse:
    """A training that collapsed."""

    trial_id: str
    best: float
    """Its best evaluation return."""
    last: float
    """Its last."""


@dataclass(frozen=True)
class _Curve:
    """A trial's evaluations and where it began, in quarters: those are exact, and all their differences finite."""

    evaluations: list[float]
    began: float

    @property
    def gain(self) -> float:
        return max(self.evaluations) - self.began


def collapsed_trials(
    trials: Sequence[TrialRecord], results: Mapping[str, Sequence[IterationRecord]]
) -> dict[str, bool | None]:
    """Return whether each trial of a sweep collapsed, by its id; None: it has not ended, or has no two evaluations.

    A trial that was never evaluated above where it began had nothing to lose, and has not collapsed; nor has a
    baseline, which learns nothing. A trial of a population is judged by its own evaluations, whatever weights it
    copied.

    Args:
        trials: The trials of one sweep.
        results: Iterations by trial id, oldest first; a trial may have none.
    """
    curves = {trial.trial_id: _curve_of(results.get(trial.trial_id, ())) for trial in trials}
    most = max((curve.gain for curve in curves.values() if curve is not None), default=0.0)
    return {trial.trial_id: _collapsed(trial, curves[trial.trial_id], most) for trial in trials}


def _curve_of(iterations: Sequence[IterationRecord]) -> _Curve | None:
    evaluations = _evaluations(iterations)
    if len(evaluations) < 2:
        return None
    trained = next((item.training_return for item in iterations if item.training_return is not None), evaluations[0])
    return _Curve([value / 4.0 for value in evaluations], min(trained, evaluations[0]) / 4.0)


def _collapsed(trial: TrialRecord, curve: _Curve | None, most: float) -> bool | None:
    if trial.status not in FINISHED or curve is None:
        return None
    if trial.engine == "baseline" or curve.gain < LEAST_GAIN * most:
        return False
    return bool(has_collapsed(curve.evaluations, share=SHARE, baseline=curve.began))


def collapses(
    trial_ids: Sequence[str], trials: Sequence[TrialRecord], results: Mapping[str, Sequence[IterationRecord]]
) -> list[Collapse]:
    """Return which of some trials collapsed, in their order.

    Args:
        trial_ids: The trials that are asked about; those that are not among `trials` are left out.
        trials: All trials of the sweep.
        results: Iterations by trial id, oldest first.
    """
    known = collapsed_trials(trials, results)
    evaluations = {trial_id: _evaluations(results[trial_id]) for trial_id in trial_ids if known.get(trial_id)}
    return [Collapse(trial_id, max(values), values[-1]) for trial_id, values in evaluations.items()]


def collapses_text(found: Sequence[Collapse], num_trainings: int) -> str:
    """Say which trainings collapsed: "1 of 3 trainings collapsed: t0004 from 500.0 to 21.0 (...)"; empty: none did.

    Args:
        found: Those that did.
        num_trainings: How many there are in all.
    """
    if not found:
        return ""
    named = [f"{item.trial_id} from {range_text(item.best, item.last)}" for item in found]
    more = f" and {len(named) - _MAX_NAMED:,} more" if len(named) > _MAX_NAMED else ""
    who = ", ".join(named[:_MAX_NAMED]) + more
    return f"{len(found):,} of {counted(num_trainings, 'training')} collapsed: {who} (best and last evaluation)"


def _evaluations(iterations: Sequence[IterationRecord]) -> list[float]:
    return [item.evaluation_return for item in iterations if item.evaluation_return is not None]

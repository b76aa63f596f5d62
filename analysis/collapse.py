"""Which trials collapsed: ended far below what they had learnt.

A trial's evaluations are compared with where it began: its first evaluation or its first training return, whichever is
lower. The first evaluation may come when much is learnt already, and early training returns are those of a policy that
explores. What counts is the share of that gain which is lost, so that the sign and size of returns do not matter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from analysis.records import FINISHED, IterationRecord, TrialRecord
from analysis.statistics import has_collapsed
from analysis.wording import counted, return_text

SHARE = 0.5
"""A trial collapsed if its last evaluation lost more than this share of what its best one had gained."""
COLLAPSE_MEANS = (
    "A trial collapsed if, by its last evaluation, it had lost more than half of what its best one had gained over "
    "where it began: over its first evaluation or its first training return, whichever is lower."
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


def trial_collapsed(trial: TrialRecord, iterations: Sequence[IterationRecord]) -> bool | None:
    """Return whether a trial collapsed; None: it has not ended, or has fewer than two evaluations.

    A trial that was never evaluated above where it began had nothing to lose, and has not collapsed; nor has a
    baseline, which learns nothing. A trial of a population is judged by its own evaluations, whatever weights it
    copied.

    Args:
        trial: The trial.
        iterations: Its iterations, oldest first.
    """
    evaluations = _evaluations(iterations)
    if trial.status not in FINISHED or len(evaluations) < 2:
        return None
    if trial.engine == "baseline":
        return False
    began = next((item.training_return for item in iterations if item.training_return is not None), evaluations[0])
    # A quarter of each number is exact, and the difference of any two quarters is finite.
    quarters = [value / 4.0 for value in evaluations]
    return bool(has_collapsed(quarters, share=SHARE, baseline=min(began / 4.0, quarters[0])))


def collapses(
    trial_ids: Sequence[str], trials: Sequence[TrialRecord], results: Mapping[str, Sequence[IterationRecord]]
) -> list[Collapse]:
    """Return which of some trials collapsed, in their order.

    Args:
        trial_ids: The trials that are asked about; those that are not among `trials` are left out.
        trials: The trials of one sweep.
        results: Iterations by trial id, oldest first.
    """
    by_id = {trial.trial_id: trial for trial in trials}
    found = []
    for trial_id in trial_ids:
        iterations = results.get(trial_id, ())
        if trial_id in by_id and trial_collapsed(by_id[trial_id], iterations):
            evaluations = _evaluations(iterations)
            found.append(Collapse(trial_id, max(evaluations), evaluations[-1]))
    return found


def collapses_text(found: Sequence[Collapse], num_trainings: int) -> str:
    """Say which trainings collapsed: "1 of 3 trainings collapsed: t0004 from 500.0 to 21.0 (...)"; empty: none did.

    Args:
        found: Those that did.
        num_trainings: How many there are in all.
    """
    if not found:
        return ""
    named = [f"{item.trial_id} from {return_text(item.best)} to {return_text(item.last)}" for item in found]
    more = f" and {len(named) - _MAX_NAMED:,} more" if len(named) > _MAX_NAMED else ""
    who = ", ".join(named[:_MAX_NAMED]) + more
    return f"{len(found):,} of {counted(num_trainings, 'training')} collapsed: {who} (best and last evaluation)"


def _evaluations(iterations: Sequence[IterationRecord]) -> list[float]:
    return [item.evaluation_return for item in iterations if item.evaluation_return is not None]

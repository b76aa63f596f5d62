"""Sub-populations that select at several frequencies: MF-PBT (Doulazmi et al. 2025), as decision 46 has it.

The trials of a *sub-population* are compared with each other alone. A *faster* one selects after fewer env steps than a
*slower* one; they are numbered from the fastest. Between them trials *migrate*: one that is not bad enough to be
replaced by its own takes over the weights of a better trial of another sub-population. It takes over that one's values
too if they come from a slower sub-population. Those of a faster one were selected by what they gain soon, so it takes
those of its own best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

from tune_jobs.spec.scheduler import num_worst


def subpopulation_of(trial_index: int, num_subpopulations: int) -> int:
    """Return the number of a trial's sub-population, which depends on nothing that happens.

    Of so many trials in a row each sub-population gets one. Who begins moves on from row to row, or a grid of as many
    values would give each sub-population one value.
    """
    row, place = divmod(trial_index, num_subpopulations)
    return (row + place) % num_subpopulations


@dataclass(frozen=True)
class Ranked:
    """The trials of a sub-population by their scores. Those in between, if there are any, keep what they have."""

    worst: tuple[str, ...]
    """Those that go on from copies of their own best, the worst first."""
    open_to_others: tuple[str, ...]
    """The next worse ones, as many if there are; they go on from trials that migrate. The best first."""
    best: tuple[str, ...]
    """As many as there are worst ones, the best of all last."""

    @classmethod
    def of(cls, scores: Mapping[str, float], fraction: float) -> Self:
        """Rank trials; of equal ones those that are named first are worse.

        Args:
            scores: By trial.
            fraction: The share of the trials that is worst, and the share that is best: at most half.
        """
        names = sorted(scores, key=lambda name: scores[name])
        num = num_worst(len(names), fraction)
        between = names[num : len(names) - num]
        return cls(tuple(names[:num]), tuple(reversed(between[:num])), tuple(names[len(names) - num :]))


class Migration(NamedTuple):
    """What a trial that is open to others goes on with."""

    weights_of: str
    """A trial of another sub-population."""
    values_of: str
    """The same trial, or the best of its own sub-population."""


def migrations(own: int, ranked: Sequence[Ranked], scores: Mapping[str, float]) -> dict[str, Migration]:
    """Return who goes on from a trial of another sub-population, and with whose values.

    The best of all others go first, each to one trial, and only to one that is worse.

    Args:
        own: The number of the sub-population that selects.
        ranked: All sub-populations, the fastest first.
        scores: Of all trials in them.
    """
    # Of their best alone: none of these is changed at the same comparison.
    slower = {name: number > own for number, each in enumerate(ranked) if number != own for name in each.best}
    # In the order of trials where scores are equal.
    coming = sorted((name for name in scores if name in slower), key=lambda name: -scores[name])
    found: dict[str, Migration] = {}
    for name in ranked[own].open_to_others:
        if len(found) < len(coming) and scores[coming[len(found)]] > scores[name]:
            migrant = coming[len(found)]
            found[name] = Migration(migrant, migrant if slower[migrant] else ranked[own].best[-1])
    return found

"""The Pareto front of score against cost over settings, and the cheapest setting near the best (decision 44).

A setting's *cost* is the mean of the env steps that a training with it takes, over its seeds (`SettingScores.cost`). It
is *on the front* if no other setting is as cheap and better, or as good and cheaper; scores are the expected means by
which settings are ranked. A setting of which no seed was scored is not on it: its score is the worst of the others, and
a short one that only crashed would be the cheapest way to have that.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence

import numpy as np

from analysis.best_records import FrontPointRecord, FrontRecord
from analysis.objectives import SettingScores
from analysis.records import IterationRecord
from analysis.statistics import known_intervals, tell_the_best, tie_groups
from policies import random_streams

NEAR = 0.05
"""The share of what training gains, from the untrained policy to the best setting, that one near it loses at most."""
_NUM_LISTED = 50
_NUM_UNDECIDED = 10
_LEAST_RATIO = 30.0
"""From where on costs lie far apart: the greatest of the least."""


def front_of(ranking: Sequence[SettingScores], untrained: float | None) -> FrontRecord | None:
    """Return the front over the settings of a sweep; None: none was scored, or their scores are not finite.

    *Near the best* is a setting that loses at most `NEAR` of what the best one gains on the untrained policy, by
    expected means; the cheapest of them is always on the front. Where training gained nothing, or what an untrained
    policy scores is not known, only what scores as the best does is near it.

    That a setting is not on the front is taken for certain where another, no dearer one is better by more than the
    comparison intervals of both (`statistics.tie_groups`): with 95 %, this is said of no setting that is on it. Costs
    are taken as they are.

    Args:
        ranking: The settings, best first.
        untrained: What an untrained policy scores, see `untrained_return`; None: it is not known.
    """
    order = _by_cost(ranking)
    if not order or not all(math.isfinite(item.expected) for item in ranking):
        return None
    on_front = _non_dominated(ranking, order)
    leader = ranking[min(order)]
    best = leader.expected
    gained = 0.0 if untrained is None else max(0.0, best - untrained)
    near_score = best - NEAR * gained
    cheapest = next(index for index in order if ranking[index].expected >= near_score)
    intervals, may_be, with_best = _certainty(ranking, order)
    undecided = [] if may_be is None else [index for index in order if index in may_be and index not in on_front]

    def told(index: int) -> FrontPointRecord:
        item, interval = ranking[index], intervals[index]
        return FrontPointRecord(
            rank=index + 1, point_index=item.point_index, point=item.point, num_seeds=len(item.scores),
            score=item.mean, expected=item.expected, num_env_steps=item.cost, lower=interval[0], upper=interval[1],
        )  # fmt: skip

    return FrontRecord(
        points=tuple(map(told, on_front[:_NUM_LISTED])),
        num_on_front=len(on_front),
        undecided=tuple(map(told, undecided[:_NUM_UNDECIDED])),
        num_undecided=None if may_be is None else len(undecided),
        cheapest_near=told(cheapest),
        best_env_steps=leader.cost,
        near_share=NEAR,
        untrained=untrained,
        near_score=near_score,
        may_be_best=None if with_best is None else cheapest in with_best,
        most_seeds=max(len(item.scores) for item in ranking),
    )


def other_settings(ranking: Sequence[SettingScores], front: FrontRecord, most: int) -> list[SettingScores]:
    """Return the settings that are neither on a front nor among its undecided, best first; evenly, if too many.

    Args:
        ranking: The settings that the front is of, best first.
        front: Their front.
        most: How many are wanted at most.
    """
    known = points_on_front(ranking) | {item.point_index for item in front.undecided}
    others = [item for item in ranking if item.point_index not in known]
    picks = np.linspace(0, len(others) - 1, min(len(others), most)).round().astype(int).tolist()
    return [others[pick] for pick in picks]


def costs_lie_far_apart(ranking: Sequence[SettingScores]) -> bool:
    """Whether the costs of settings are better drawn to a logarithmic scale."""
    costs = [item.cost for item in ranking]
    return min(costs) > 0 and max(costs) / min(costs) >= _LEAST_RATIO


def untrained_return(results: Mapping[str, Sequence[IterationRecord]]) -> float | None:
    """Return what untrained policies score: the median over trials of the mean return of their first whole episodes.

    Those are of the first iteration in which any episodes ended.

    Args:
        results: Iterations by trial id, oldest first.
    """
    found = []
    for items in results.values():
        first = next((kept for item in items if (kept := list(filter(math.isfinite, item.episode_returns)))), None)
        if first is not None:
            found.append(math.fsum(value / len(first) for value in first))
    return statistics.median(found) if found else None


def settings_on_front(ranking: Sequence[SettingScores]) -> list[SettingScores]:
    """Return all settings on the front, the cheapest first, of which a record lists some; their scores are finite."""
    return [ranking[index] for index in _non_dominated(ranking, _by_cost(ranking))]


def points_on_front(ranking: Sequence[SettingScores]) -> set[int]:
    """Return the indices of the points whose settings are on the front."""
    if not all(math.isfinite(item.expected) for item in ranking):
        return set()
    return {item.point_index for item in settings_on_front(ranking)}


def _by_cost(ranking: Sequence[SettingScores]) -> list[int]:
    """Return the indices of settings of which a seed was scored, the cheapest first; of equal ones, the best."""
    scored = (index for index, item in enumerate(ranking) if item.num_unscored < len(item.scores))
    return sorted(scored, key=lambda index: (ranking[index].cost, index))


def _non_dominated(ranking: Sequence[SettingScores], order: Sequence[int]) -> list[int]:
    """Return the indices of those on the front, the cheapest first; equal ones are on it together."""
    found: list[int] = []
    for index in order:
        item, last = ranking[index], ranking[found[-1]] if found else None
        if last is None or item.expected > last.expected or (item.expected, item.cost) == (last.expected, last.cost):
            found.append(index)
    return found


def _certainty(
    ranking: Sequence[SettingScores], order: Sequence[int]
) -> tuple[list[tuple[float | None, float | None]], set[int] | None, set[int] | None]:
    """Return the interval of each setting, who may be on the front, and who may be the best; None: nothing says so."""
    unknown: list[tuple[float | None, float | None]] = [(None, None)] * len(ranking)
    scores = [item.scores for item in ranking]
    if max(map(len, scores)) < 2:
        return unknown, None, None
    try:
        if not tell_the_best(scores):
            return unknown, None, None
        ties = tie_groups(scores, rng=random_streams.fixed())
    except ValueError:  # scores so large that their squares are not finite
        return unknown, None, None
    may_be, bar = set(), -math.inf
    lower, upper = ties.means - ties.half_widths, ties.means + ties.half_widths
    # Those of equal cost are compared with each other too.
    costs = [ranking[index].cost for index in order]
    for place, index in enumerate(order):
        if place == 0 or costs[place] != costs[place - 1]:
            same = (other for other, cost in zip(order[place:], costs[place:], strict=True) if cost == costs[place])
            bar = max(bar, *(float(lower[other]) for other in same))
        if upper[index] >= bar:
            may_be.add(index)
    intervals: list[tuple[float | None, float | None]] = [
        (None, None) if item is None else (item.lower, item.upper) for item in known_intervals(scores)
    ]
    return intervals, may_be, set(ties.with_leader)

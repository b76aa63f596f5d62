"""Score and cost as one number, which a search method is told as the score where the sweep asks for both.

A model of one number looks for one best point, and a front has many. So for each point that is asked for, score and
cost are weighed anew, by a weight that is drawn: over many points all of the front is searched, by any method.

Source:
    Knowles 2006, "ParEGO: A Hybrid Algorithm With On-Line Landscape Approximation for Expensive Multiobjective
    Optimization Problems", equation 2 with its rho of 0.05: the larger of the weighted losses, and a little of their
    sum.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import replace

from policies import random_streams
from tune_jobs.search.history import KnownPoint

_RHO = 0.05
_MOST_LOSS = 4.0
"""What is lost beyond so many times the median loss counts by its logarithm: one training that diverged to minus a
million would else make all others equally good, and leave the cost alone to search by."""


def weighed(known: Sequence[KnownPoint], index: int, seed: int) -> list[KnownPoint]:
    """Return known points with one number for score and cost as their scores, higher is better.

    Scores and costs are counted in shares of their range among the ended seeds, scores of the usual part of it. A seed
    without a score has none.

    Args:
        known: Points with scores and costs.
        index: The index of the point that is asked for: its weight belongs to it.
        seed: The sweep's seed.
    """
    pairs = [
        (score, cost)
        for point in known
        for score, cost in zip(point.scores, point.env_steps, strict=True)
        if score is not None
    ]
    if not pairs:
        return list(known)
    best, least = max(score for score, _ in pairs), min(cost for _, cost in pairs)
    # Divided first, as the difference of two scores may be too large for a float.
    lost = [best / 2 - score / 2 for score, _ in pairs if score < best]
    scores = min(max(lost), _MOST_LOSS * statistics.median_low(lost)) if lost else 1.0
    costs = (max(cost for _, cost in pairs) - least) or 1
    weight = float(random_streams.objective_weights(seed, index).random())

    def number(score: float | None, cost: int) -> float | None:
        if score is None:
            return None
        losses = weight * _tamed((best / 2 - score / 2) / scores), (1.0 - weight) * ((cost - least) / costs)
        return -(max(losses) + _RHO * sum(losses))

    # What a point had come to at rungs has no cost that could be set against another's.
    return [
        replace(
            point, scores=tuple(number(*pair) for pair in zip(point.scores, point.env_steps, strict=True)), passed=()
        )
        for point in known
    ]


def _tamed(loss: float) -> float:
    """Return a loss in shares of the usual range, which grows but slowly beyond it."""
    return loss if loss <= 1.0 else 1.0 + math.log(loss)

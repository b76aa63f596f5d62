"""The scores of points as a model of our own is told them, such that no scale of returns is a bad one.

Returns are skewed in every direction: most settings of one task are worth nothing, a few of another diverge to minus a
million. A model that expects normal noise around a smooth function is misled by both. So the worse half of all points
counts by its ranks alone, and the better half as much by the logarithm of how far above the median it is (the half-rank
and log warpings of Song et al. 2024, "The Vizier Gaussian Process Bandit Algorithm", in one, and beside it the ranks,
which tell points apart where one is far above all others).

What is warped is the mean over a point's seeds, by which points are compared: means of warped scores would be in
another order. The scores of the seeds themselves tell how far a mean can be trusted.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tune_jobs.search.coordinates import Cube
from tune_jobs.search.fidelity import NO_COLUMN, Lengths
from tune_jobs.search.gaussian_process import Observed
from tune_jobs.search.history import KnownPoint

Floats = NDArray[np.float64]


class Warped(NamedTuple):
    """The scores of points, each array of shape (num_points,)."""

    scores: Floats
    """Of mean 0 and variance 1, unless all are equal."""
    counts: Floats
    """Of how many seeds each is the mean."""
    spreads: Floats
    """The sum of the squared differences between the scores of a point's seeds, warped in the same way, and its own."""


def warped(known: Sequence[KnownPoint], *, by_level: bool = True) -> Warped:
    """Return the scores that a model is told.

    Points with a seed that failed, or was never scored, are worse than all without, the more of them the worse. Points
    that a scheduler ended are worse than those that it did not end, and better the further they got. Equal means are
    equal.

    Args:
        known: Points that have ended.
        by_level: False: those that a scheduler ended are compared with the others by their scores, as a model is that
            is told the lengths of their trainings.
    """
    table = _table(known, by_level=by_level)
    shares = _shares(table)
    scores = _with_distances(_normal_quantiles(shares), table, shares)
    scores = scores - scores.mean()
    if (deviation := float(scores.std())) > 0:
        scores = scores / deviation
    return _with_seeds(known, scores, by_level=by_level)


def shares_of(known: Sequence[KnownPoint]) -> Floats:
    """Return the share of points that each is better than, where half of those that are equal to it count.

    Args:
        known: As for `warped`.
    """
    return _shares(_table(known))


def _table(known: Sequence[KnownPoint], *, by_level: bool = True) -> Floats:
    """Return what `rank_of` says of points, shape (num_points, 2)."""
    table = np.fromiter(itertools.chain.from_iterable(map(rank_of, known)), np.float64).reshape(-1, 2)
    if not by_level:
        table[table[:, 0] >= 0, 0] = math.inf
    return table


def _shares(table: Floats) -> Floats:
    order = np.lexsort((table[:, 1], table[:, 0]))
    ordered = table[order]
    places = np.empty(len(table), dtype=np.int64)
    places[order] = np.concatenate([[0], (ordered[1:] != ordered[:-1]).any(axis=1)])[: len(table)].cumsum()
    counts = np.bincount(places)
    shares: Floats = ((np.cumsum(counts) - counts / 2) / max(1, len(table)))[places]
    return shares


def rank_of(point: KnownPoint) -> tuple[float, float]:
    """Return what orders points: how comparable their scores are, then the scores."""
    if (score := point.score) is None:
        return -1.0, -sum(each is None for each in point.scores) / max(1, len(point.scores))
    return math.inf if point.level is None else float(point.level), score


def _with_distances(quantiles: Floats, keys: Floats, shares: Floats) -> Floats:
    """Return the quantiles, of which those of the better half, if nothing ended it, also tell how much better it is.

    What counts by the rung that a scheduler ended it at is of another scale, as it was judged earlier.
    """
    upper = np.isinf(keys[:, 0]) & (shares >= 0.5)
    if not upper.any():
        return quantiles
    values = _with_finite_differences(keys[upper, 1])
    above = values - values.min()
    usual = float(above.max())
    if usual > 0:
        # Divided first, as squares of large numbers would be infinite.
        usual *= float(np.sqrt(((above / usual) ** 2).mean()))
        distances = quantiles[upper].min() + np.log1p(above / usual) / math.log(2.0)
        quantiles = quantiles.copy()
        quantiles[upper] = (quantiles[upper] + distances) / 2
    return quantiles


def _with_finite_differences(values: Floats) -> Floats:
    """Return numbers, or their halves where two of them are too far apart for a float; only ratios are made of them."""
    return values / 2.0 if math.isinf(float(values.max()) - float(values.min())) else values


def _with_seeds(known: Sequence[KnownPoint], scores: Floats, *, by_level: bool) -> Warped:
    counts, spreads = np.ones(len(known)), np.zeros(len(known))
    compared = [
        index for index, point in enumerate(known) if (point.level is None or not by_level) and point.score is not None
    ]
    several = [index for index in compared if len(known[index].scores) > 1]
    if several:
        means, first = np.unique([known[index].score for index in compared], return_index=True)
        warped_means = scores[compared][first]
        each = [np.interp(np.array(known[index].scores), means, warped_means) for index in several]
        counts[several] = [len(seeds) for seeds in each]
        spreads[several] = [((seeds - scores[index]) ** 2).sum() for index, seeds in zip(several, each, strict=True)]
    return Warped(scores, counts, spreads)


def observed(
    cube: Cube, known: Sequence[KnownPoint], most: int, lengths: Lengths = NO_COLUMN
) -> tuple[Observed, Floats]:
    """Return what a model is given of points, and their places in the cube, shape (at most `most`, num_sides).

    Args:
        cube: The search space.
        known: All points; those that run are left out, because the seeds that end first are not like the others.
        most: How many points the model takes: the best ones, the newest, and some of the others.
        lengths: The column by which the model knows how far trainings went, if it has one.
    """
    ended = [point for point in known if not point.is_running]
    scores, counts, spreads = warped(ended, by_level=not lengths.is_column)
    chosen = _some(scores, most)
    units = cube.units([ended[index].point for index in chosen])
    columns = lengths.beside(cube.columns(units), [ended[index] for index in chosen])
    return Observed(columns, scores[chosen], counts[chosen], float(spreads[chosen].sum())), units


def tried(cube: Cube, known: Sequence[KnownPoint], most: int) -> Floats:
    """Return the places of points that have ended, shape (at most `most`, num_sides), each point counted once.

    Args:
        cube: The search space.
        known: All points.
        most: As for `observed`.
    """
    ended = [point for point in known if not point.is_running]
    scores = np.array([-math.inf if point.score is None else point.score for point in ended])
    return cube.units([ended[index].point for index in _some(scores, most)])


def _some(means: Floats, most: int) -> NDArray[np.int64]:
    """Return the indices of the best points, the newest, and some of the others, in order."""
    number = len(means)
    if number <= most:
        return np.arange(number)
    third = most // 3
    best = np.argsort(-means, kind="stable")[:third]
    chosen = np.unique(np.concatenate([best, np.arange(number - third, number)]))
    others = np.setdiff1d(np.arange(number), chosen)
    spread = others[np.linspace(0, len(others) - 1, most - len(chosen)).round().astype(np.int64)]
    return np.sort(np.concatenate([chosen, spread]))


def _normal_quantiles(shares: Floats) -> Floats:
    from scipy.special import ndtri

    quantiles: Floats = ndtri(shares)
    return quantiles

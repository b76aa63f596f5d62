"""Which setting is the best: tie groups, and the probability of each.

Both begin with `moderated_means`, so that few seeds, or seeds that all score the same, make no setting look certain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.estimate import Values, check_count, check_level, exponent_of, finite_arrays
from analysis.statistics.many_settings import ModeratedMeans, moderated_means

_NUM_SPREADS = 100


@dataclass(frozen=True)
class TieGroups:
    """Which of K settings the data can't order."""

    means: NDArray[np.float64]
    """Mean scores over training seeds, shape (K,)."""
    half_widths: NDArray[np.float64]
    """Half the width of each setting's comparison interval, shape (K,): settings are ordered where mean -+ half width
    of the two don't overlap. A comparison interval says nothing about the score itself; `seed_intervals` do."""
    groups: tuple[tuple[int, ...], ...]
    """Indices of settings, best mean first. Inside of a group nobody is told from anybody; two settings that are in no
    group together differ. A setting may be in several groups, as it may tie with two that differ."""
    with_leader: tuple[int, ...]
    """Indices of the settings that may be the best, best mean first: the others are worse than some setting."""


def tie_groups(
    settings: Sequence[Values], *, rng: np.random.Generator, num_draws: int = 2_000, level: float = 0.95
) -> TieGroups:
    """Return which settings the data can't order, and which may be the best.

    Errors of the means are drawn from their t-distributions, as if all settings were equally good. Groups are by
    comparison intervals, mean -+ c SE, where with probability `level` no two such errors lie so far apart that their
    intervals don't overlap: with that probability, no two settings are said to differ that don't, out of all pairs.
    That is a max-t correction of all K (K - 1) / 2 comparisons, sharper than Holm's, as it knows which comparisons
    share a setting.

    `with_leader` asks less and so tells apart more: a setting is left out if one of the others is better than it by
    more than a smaller c allows, which is drawn for the K - 1 comparisons of one setting with all others. The best
    setting is in it with probability `level`.

    Args:
        settings: For each setting one score a training seed, the higher the better; they may differ in number.
        rng: Draws the errors; the same state gives the same groups.
        num_draws: How many errors of all settings are drawn. They take 8 bytes a draw and setting.
        level: The probability that no false statement is made, in (0, 1); separately for groups and `with_leader`.

    Returns:
        The groups; of one setting, one group. If in no setting any two seeds differ, only equal means tie.

    Raises:
        ValueError: In the cases of `moderated_means`, the level is outside (0, 1), or there are no draws.

    Source:
        Gabriel 1978, "A Simple Method of Multiple Comparisons of Means" (intervals that don't overlap); Westfall &
        Young 1993, "Resampling-Based Multiple Testing" (max-t); Gupta 1965, "On Some Multiple Decision (Selection and
        Ranking) Rules" (a subset that holds the best).
    """
    check_level(level)
    check_count(num_draws, "num_draws")
    fit = moderated_means(settings)
    scales = fit.standard_errors
    draws = _draw_errors(fit, rng, num_draws)
    any_pair = float(np.quantile(_largest_pairs(draws, scales), level, method="higher"))
    with_best = _one_with_all(draws, scales, level, any_pair)
    half_widths = any_pair * scales
    order = np.argsort(-fit.means, kind="stable")
    upper = fit.means + with_best * scales
    may_be_best = upper[order] >= (fit.means - with_best * scales).max()
    groups = _overlapping(fit.means[order] - half_widths[order], fit.means[order] + half_widths[order], order)
    return TieGroups(fit.means, half_widths, groups, tuple(order[may_be_best].tolist()))


def probability_of_being_best(
    settings: Sequence[Values], *, rng: np.random.Generator, num_draws: int = 4_000
) -> NDArray[np.float64]:
    """Return for each setting the probability that its true mean over training seeds is the highest.

    True means are drawn from their posterior in a normal hierarchical model: settings come from a normal distribution,
    whose mean and spread are learnt from all of them, and seeds from a t-distribution around each setting. So the
    leader of many settings isn't believed too much: the best of twenty means is mostly a lucky one, and is drawn back
    to the others, the more the less settings differ.

    It is calibrated within five points below 30 %, and above where settings differ about as much as their seeds or
    more. Above 50 % it is too sure, by 15 to 35 points, where settings hardly differ or the best of them crowd below a
    ceiling: what it gives more than 50 % there is rare, and `tie_groups` is to be asked. Settings that are exactly as
    good share what the best of them has. Decision 28 has the figures.

    Args:
        settings: For each setting one score a training seed, the higher the better; they may differ in number.
        rng: Draws the means; the same state gives the same probabilities.
        num_draws: How many times all true means are drawn. With 4,000 a probability has a standard error of 0.8 points
            at most.

    Returns:
        Shape (K,), with sum 1. Where all means are equal, so are the probabilities. If in no setting any two seeds
        differ, the highest means share it all.

    Raises:
        ValueError: In the cases of `moderated_means`, or there are no draws.

    Source:
        Gelman et al. 2013, "Bayesian Data Analysis", section 5.4 (posterior of the spread on a grid, uniform prior);
        Smyth 2004 for the variances.
    """
    check_count(num_draws, "num_draws")
    arrays = finite_arrays(settings, "settings")
    # In units of a power of two, by which nothing is rounded, as the squares of small scores are lost.
    exponent = exponent_of(np.concatenate(arrays))
    fit = moderated_means([np.ldexp(array, -exponent) for array in arrays])
    means, num_settings = fit.means, fit.means.size
    says_nothing = fit.standard_errors.max() == 0.0 or means.min() == means.max()
    spread = 0.0 if says_nothing else float(means.std(ddof=1))
    if spread == 0.0:
        leaders = means == means.max()
        return np.where(leaders, 1.0 / np.count_nonzero(leaders), 0.0)
    spreads, weights = _spread_posterior(means, fit.standard_errors**2, spread)
    wins = np.zeros(num_settings, dtype=np.int64)
    for size in fit.blocks(num_draws):
        variances = (fit.standard_errors * fit.relative_errors(rng, size)) ** 2
        between = rng.choice(spreads, size=(size, 1), p=weights) ** 2
        precision = 1.0 / (between + variances)
        total = precision.sum(axis=1, keepdims=True)
        centre = (precision * means).sum(axis=1, keepdims=True) / total
        centre = centre + rng.standard_normal((size, 1)) / np.sqrt(total)
        kept = between * precision
        drawn = centre + kept * (means - centre) + np.sqrt(kept * variances) * rng.standard_normal(variances.shape)
        wins += np.bincount(drawn.argmax(axis=1), minlength=num_settings)
    return wins / num_draws


def _spread_posterior(
    means: NDArray[np.float64], variances: NDArray[np.float64], spread: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a grid of standard deviations between true means and their posterior weights (Gelman et al., eq. 5.21)."""
    spreads = (np.arange(_NUM_SPREADS) + 0.5) / _NUM_SPREADS * 4.0 * spread
    precision = 1.0 / (spreads[:, np.newaxis] ** 2 + variances)
    total = precision.sum(axis=1)
    centre = (precision * means).sum(axis=1) / total
    misfit = (precision * (means - centre[:, np.newaxis]) ** 2).sum(axis=1)
    log_weights = 0.5 * (np.log(precision).sum(axis=1) - np.log(total) - misfit)
    weights = np.exp(log_weights - log_weights.max())
    return spreads, weights / weights.sum()


def _draw_errors(fit: ModeratedMeans, rng: np.random.Generator, num_draws: int) -> NDArray[np.float64]:
    """Draw errors of the means, shape (num_draws, K)."""
    errors = np.empty((num_draws, fit.means.size))
    start = 0
    for size in fit.blocks(num_draws):
        rows = errors[start : start + size]
        rows[:] = rng.standard_normal(rows.shape) * fit.relative_errors(rng, size) * fit.standard_errors
        start += size
    return errors


def _largest_pairs(draws: NDArray[np.float64], scales: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return for each draw the largest |e_i - e_j| / (s_i + s_j) of all pairs, shape (num_draws,).

    It is the least c for which all intervals e -+ c s have a point in common, found as the root of a convex,
    decreasing function of c by Newton's method (Dinkelbach 1967), so that not all pairs have to be looked at.
    """
    largest = np.zeros(len(draws))
    if scales.max() == 0.0:
        return largest
    rows = np.arange(len(draws))
    while True:
        shift = largest[:, np.newaxis] * scales
        high, low = (draws - shift).argmax(axis=1), (draws + shift).argmin(axis=1)
        gap = draws[rows, high] - draws[rows, low]
        better = np.divide(gap, scales[high] + scales[low], out=np.zeros_like(gap), where=high != low)
        if not (better > largest * (1.0 + 1e-9)).any():
            return largest
        largest = np.maximum(largest, better)


def _one_with_all(draws: NDArray[np.float64], scales: NDArray[np.float64], level: float, limit: float) -> float:
    """Return c for which each setting, were it the best, is with this probability not left out by any other.

    A setting b is left out where e_j - e_b > c (s_j + s_b) for some j.
    """
    low, high = 0.0, limit
    for _ in range(20):
        middle = (low + high) / 2.0
        highest = (draws - middle * scales).max(axis=1, keepdims=True)
        kept = (highest <= draws + middle * scales).mean(axis=0).min()
        low, high = (low, middle) if kept >= level else (middle, high)
    return high


def _overlapping(
    lower: NDArray[np.float64], upper: NDArray[np.float64], names: NDArray[np.int64]
) -> tuple[tuple[int, ...], ...]:
    """Return the largest sets of intervals that all overlap, from the highest to the lowest, in the order given.

    From above, such a set is whole where an interval ends and the last event was that one began.
    """
    places = np.concatenate([upper, lower])
    is_end = np.repeat([False, True], upper.size)
    events = np.lexsort((is_end, -places))
    ends = is_end[events]
    whole = events[1:][ends[1:] & ~ends[:-1]]
    return tuple(tuple(names[(upper >= place) & (lower <= place)].tolist()) for place in places[whole])

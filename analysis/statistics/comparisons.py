"""Runs over several tasks: interquartile mean, performance profiles, and how often runs of X beat those of Y.

A *task* is a stratum: what runs are compared within, such as an environment, or a setting that two sweeps share. Scores
of different tasks must be on one scale (normalised) for the interquartile mean and for profiles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.estimate import Estimate, Values, check_count, check_level, finite_1d, finite_arrays
from analysis.statistics.means import MIN_SEEDS_FOR_INTERVAL, iqm
from analysis.statistics.student_t import normal_quantile, normal_tail, t_quantile

_BLOCK_VALUES = 2_000_000


@dataclass(frozen=True)
class Profile:
    """A performance profile, or score distribution: at each threshold the share of runs that score more."""

    thresholds: NDArray[np.float64]
    """Scores, shape (T,)."""
    shares: NDArray[np.float64]
    """The share of runs above each threshold, averaged over tasks, shape (T,)."""
    lower: NDArray[np.float64]
    """The lower end of the pointwise interval, shape (T,)."""
    upper: NDArray[np.float64]
    """The upper end, shape (T,)."""


def iqm_with_ci(
    tasks: Sequence[Values], *, rng: np.random.Generator, num_resamples: int = 2_000, level: float = 0.95
) -> Estimate:
    """Return the interquartile mean of the runs of all tasks, with a stratified bootstrap interval.

    Runs are resampled within each task, as many as it has; the runs of all tasks together are then cut and averaged, as
    in `iqm`. Resampled runs vary less than fresh ones, so the quantiles are taken further out, by as much as a normal
    interval would have to be widened to be Student's. With five or ten runs a task it covers about what it states.

    Args:
        tasks: For each task one normalised score a run; they may differ in number.
        rng: Draws the resamples; the same state gives the same interval.
        num_resamples: How many resamples are drawn.
        level: Share of resampled interquartile means inside the interval, in (0, 1).

    Returns:
        The interquartile mean; its note says so where there are so few runs that the interval may be too narrow.

    Raises:
        ValueError: There are no tasks, one has no score or one that is not finite, no task has two runs, the level is
            outside (0, 1), or there are no resamples.

    Source:
        Agarwal et al. 2021, "Deep RL at the Edge of the Statistical Precipice", section 4 and appendix A.4; Hesterberg
        2015, "What Teachers Should Know About the Bootstrap", section 5.3 (expanded percentiles).
    """
    check_level(level)
    check_count(num_resamples, "num_resamples")
    arrays = finite_arrays(tasks, "tasks")
    total = sum(array.size for array in arrays)
    if total == len(arrays):
        raise ValueError("no task has two runs, so nothing is known of how runs differ")
    cut = total // 4
    estimates = np.empty(num_resamples)
    block = max(1, _BLOCK_VALUES // total)
    for start in range(0, num_resamples, block):
        size = min(block, num_resamples - start)
        picks = [array[rng.integers(0, array.size, size=(size, array.size))] for array in arrays]
        sample = np.concatenate(picks, axis=1)
        sample.partition((cut, total - cut - 1), axis=1)
        estimates[start : start + size] = sample[:, cut : total - cut].mean(axis=1)
    df = total - len(arrays)
    tail = normal_tail(math.sqrt(total / df) * t_quantile((1.0 + level) / 2.0, df))
    lower, upper = np.quantile(estimates, [tail, 1.0 - tail])
    note = f"{total} runs: the interval may be too narrow" if df < MIN_SEEDS_FOR_INTERVAL else ""
    return Estimate(iqm(np.concatenate(arrays)), float(lower), float(upper), total, note)


def performance_profile(tasks: Sequence[Values], thresholds: Values, *, level: float = 0.95) -> Profile:
    """Return the share of runs above each threshold, with pointwise intervals. Nothing is resampled.

    The share is the mean over tasks of each task's share, and the interval is Wilson's of that share, with as many runs
    as give a mean over tasks the same variance: M^2 / sum(1 / n). It has a width also where no run or each run is above
    the threshold, as a bootstrap has not, and is wider than needed where tasks of equally many runs differ. The
    interval holds for one threshold at a time: a band of all of them is wider.

    Args:
        tasks: For each task one normalised score a run; they may differ in number. A sweep over one environment is one
            task.
        thresholds: The scores at which the share is wanted, shape (T,).
        level: The share of such intervals that shall cover the truth, in (0, 1).

    Raises:
        ValueError: There are no tasks or thresholds, one is not finite, a task has no score, or the level is outside
            (0, 1).

    Source:
        Agarwal et al. 2021, section 4, "run-score distributions"; Wilson 1927, "Probable Inference, the Law of
        Succession, and Statistical Inference".
    """
    check_level(level)
    arrays = finite_arrays(tasks, "tasks")
    places = finite_1d(thresholds, "thresholds")
    above = [1.0 - np.searchsorted(np.sort(array), places, side="right") / array.size for array in arrays]
    shares = np.mean(above, axis=0)
    runs = len(arrays) ** 2 / sum(1.0 / array.size for array in arrays)
    square = normal_quantile((1.0 + level) / 2.0) ** 2
    centre = (shares + square / (2.0 * runs)) / (1.0 + square / runs)
    half = np.sqrt(square / runs * (shares * (1.0 - shares) + square / (4.0 * runs))) / (1.0 + square / runs)
    # Rounding may leave 1e-17 of what is 0.
    lower, upper = np.where(shares == 0.0, 0.0, centre - half), np.where(shares == 1.0, 1.0, centre + half)
    return Profile(places, shares, lower, upper)


def probability_of_improvement(left: Sequence[Values], right: Sequence[Values], *, level: float = 0.95) -> Estimate:
    """Return P(X > Y), the probability that a run of `left` scores more than one of `right`, with an interval.

    Ties count half. Of several tasks it is the mean of their probabilities: those of two sweeps are compared within the
    settings or environments that they share. Nothing is resampled: with five runs each a bootstrap is too narrow, and
    has no width where all of X are above all of Y. The interval holds the probabilities that are not further from the
    estimate than their standard errors allow, by the variance of Hanley and McNeil as Newcombe takes it (his method 5).
    It is wider than needed where there are many ties.

    Args:
        left: For each task one score a run of X, the higher the better. Two settings are one task: `[x]`, `[y]`.
        right: The same of Y, the same tasks in the same order; the numbers of runs may differ.
        level: The share of such intervals that shall cover the truth, in (0, 1).

    Returns:
        The probability; `num_values` is the number of runs of both.

    Raises:
        ValueError: There are no tasks, the numbers of tasks differ, a task has no score or one that is not finite, or
            the level is outside (0, 1).

    Source:
        Agarwal et al. 2021, section 4; Newcombe 2006, "Confidence intervals for an effect size measure based on the
        Mann-Whitney statistic. Part 2: asymptotic methods and evaluation".
    """
    check_level(level)
    left_arrays, right_arrays = finite_arrays(left, "left"), finite_arrays(right, "right")
    if len(left_arrays) != len(right_arrays):
        raise ValueError(f"cannot compare {len(left_arrays)} tasks with {len(right_arrays)}")
    pairs = list(zip(left_arrays, right_arrays, strict=True))
    share = float(np.mean([_share_of_wins(ours, theirs) for ours, theirs in pairs]))
    sizes = [(ours.size, theirs.size) for ours, theirs in pairs]
    z = normal_quantile((1.0 + level) / 2.0)
    ends = [_score_end(share, end, z, sizes) for end in (0.0, 1.0)]
    return Estimate(share, ends[0], ends[1], sum(m + n for m, n in sizes))


def _share_of_wins(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> float:
    ordered = np.sort(theirs)
    below, not_above = np.searchsorted(ordered, ours, side="left"), np.searchsorted(ordered, ours, side="right")
    return float((below + not_above).mean() / (2.0 * theirs.size))


def _score_end(share: float, end: float, z: float, sizes: Sequence[tuple[int, int]]) -> float:
    """Return the value between the share and `end` that is z of its own standard errors from the share."""
    inner, outer = share, end
    for _ in range(60):
        middle = (inner + outer) / 2.0
        within = abs(middle - share) <= z * _wins_error(middle, sizes)
        inner, outer = (middle, outer) if within else (inner, middle)
    return outer


def _wins_error(share: float, sizes: Sequence[tuple[int, int]]) -> float:
    """Return the standard error of the mean over tasks of shares of wins, if all have this probability."""
    growth = (1.0 - share) / (2.0 - share) + share / (1.0 + share)
    total = sum((1.0 + ((m + n) / 2.0 - 1.0) * growth) / (m * n) for m, n in sizes)
    return math.sqrt(share * (1.0 - share) * total) / len(sizes)

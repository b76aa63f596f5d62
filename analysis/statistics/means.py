"""Means of many values, resampled: interquartile mean, percentile bootstrap, paired differences.

A percentile bootstrap of fewer than `MIN_SEEDS_FOR_INTERVAL` values is far too narrow: that of three values can never
go beyond them. Of ten it still covers less than is stated (decision 28). It is meant for the many episodes of one
policy; for seeds there is `seed_intervals`. Callers that show one of few seeds should say so, by `small_sample_note`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.statistics.estimate import Estimate, Values, check_count, check_level, finite_1d, mean_of

MIN_SEEDS_FOR_INTERVAL = 5
_CHUNK_VALUES = 2_000_000


def iqm(values: Values) -> float:
    """Return the interquartile mean, the mean of the middle half; floor(n / 4) values are cut at each end.

    With fewer than four values nothing is cut: it is their mean.

    Raises:
        ValueError: There is no value, the array is not 1-D, or a value is not finite.

    Source:
        Agarwal et al. 2021, "Deep RL at the Edge of the Statistical Precipice", section 4.
    """
    array = np.sort(finite_1d(values))
    cut = array.size // 4
    return mean_of(array[cut : array.size - cut])


def mean_with_ci(
    values: Values,
    *,
    rng: np.random.Generator,
    num_resamples: int = 2_000,
    level: float = 0.95,
) -> Estimate:
    """Return the mean and its percentile bootstrap interval.

    Args:
        values: The values to resample: returns of episodes, or many scores of seeds (see the module). Shape (n,).
        rng: Draws the resamples; the same state gives the same interval.
        num_resamples: How many resamples are drawn.
        level: Share of resampled means inside the interval, in (0, 1).

    Raises:
        ValueError: There is no value, the array is not 1-D, a value is not finite, the level is outside (0, 1), or
            there are no resamples.

    Source:
        Efron & Tibshirani 1993, "An Introduction to the Bootstrap", chapter 13.
    """
    check_level(level)
    check_count(num_resamples, "num_resamples")
    array = finite_1d(values)
    # Resampled in blocks, because 2,000 x 100,000 indices would take 1.6 GB.
    block = max(1, _CHUNK_VALUES // array.size)
    means = np.empty(num_resamples)
    for start in range(0, num_resamples, block):
        stop = min(start + block, num_resamples)
        picks = rng.integers(0, array.size, size=(stop - start, array.size))
        means[start:stop] = array[picks].mean(axis=1)
    tail = (1.0 - level) / 2.0
    lower, upper = np.quantile(means, [tail, 1.0 - tail])
    return Estimate(float(array.mean()), float(lower), float(upper), array.size)


def paired_difference(
    left: Values,
    right: Values,
    *,
    rng: np.random.Generator,
    num_resamples: int = 2_000,
    level: float = 0.95,
) -> Estimate:
    """Return the mean of `left - right`, pair by pair, with a bootstrap interval over the pairs.

    Two policies on the same episode seeds meet the same initial states, whose effect cancels in the difference: the
    interval is narrower than that of two separate means.

    Raises:
        ValueError: The lengths differ, or in the same cases as `mean_with_ci`.
    """
    left_array, right_array = finite_1d(left), finite_1d(right)
    if left_array.size != right_array.size:
        raise ValueError(f"cannot pair {left_array.size} values with {right_array.size}")
    return mean_with_ci(left_array - right_array, rng=rng, num_resamples=num_resamples, level=level)


def median_steps(steps: Sequence[int | None]) -> float | None:
    """Return the median of the env steps that several seeds took to reach a goal.

    It takes a seed that never reached the goal for one that never would. Where trials ended at different env steps
    that is too hard on those that ended early: `steps_to_threshold` is not.

    Args:
        steps: The env steps of each seed; None: it never reached the goal, which counts as more than any number.

    Returns:
        The median; None if half of the seeds or more never reached the goal.

    Raises:
        ValueError: There are no seeds.
    """
    if not steps:
        raise ValueError("the median of no seeds is not defined")
    median = float(np.median([np.inf if value is None else float(value) for value in steps]))
    return median if np.isfinite(median) else None


def small_sample_note(num_values: int) -> str:
    """Return a warning about a bootstrap interval over this many seeds, or an empty string if none is needed."""
    if num_values < 2:
        return "one seed: no interval"
    if num_values < MIN_SEEDS_FOR_INTERVAL:
        return f"{num_values} seeds: the interval is too narrow"
    return ""

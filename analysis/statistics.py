"""Statistics for few, skewed returns: interquartile mean, bootstrap intervals, paired differences.

The meaning of an interval depends on what is resampled. An interval over *seeds* says how another training run of the
point would do. One over *episodes* of one policy says how that policy would do in other episodes, which says nothing
about training it again.

A percentile bootstrap of fewer than `MIN_SEEDS_FOR_INTERVAL` values is too narrow: that of three values can never go
beyond them. Callers that show one should say so, by `small_sample_note`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MIN_SEEDS_FOR_INTERVAL = 5
_CHUNK_VALUES = 2_000_000


@dataclass(frozen=True)
class Estimate:
    """A mean with its interval, in the units of the values."""

    mean: float
    lower: float
    upper: float
    num_values: int


def iqm(values: Sequence[float] | NDArray[np.float64]) -> float:
    """Return the interquartile mean, the mean of the middle half; floor(n / 4) values are cut at each end.

    With fewer than four values nothing is cut: it is their mean.

    Raises:
        ValueError: There is no value, the array is not 1-D, or a value is not finite.

    Source:
        Agarwal et al. 2021, "Deep RL at the Edge of the Statistical Precipice", section 4.
    """
    array = np.sort(_finite_1d(values))
    cut = array.size // 4
    return float(array[cut : array.size - cut].mean())


def mean_with_ci(
    values: Sequence[float] | NDArray[np.float64],
    *,
    rng: np.random.Generator,
    num_resamples: int = 2_000,
    level: float = 0.95,
) -> Estimate:
    """Return the mean and its percentile bootstrap interval.

    Args:
        values: The values to resample: scores of seeds or returns of episodes (see the module). Shape (n,).
        rng: Draws the resamples; the same state gives the same interval.
        num_resamples: How many resamples are drawn.
        level: Share of resampled means inside the interval, in (0, 1).

    Raises:
        ValueError: There is no value, the array is not 1-D, a value is not finite, or the level is outside (0, 1).

    Source:
        Efron & Tibshirani 1993, "An Introduction to the Bootstrap", chapter 13.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level {level} is not in (0, 1)")
    array = _finite_1d(values)
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
    left: Sequence[float] | NDArray[np.float64],
    right: Sequence[float] | NDArray[np.float64],
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
    left_array, right_array = _finite_1d(left), _finite_1d(right)
    if left_array.size != right_array.size:
        raise ValueError(f"cannot pair {left_array.size} values with {right_array.size}")
    return mean_with_ci(left_array - right_array, rng=rng, num_resamples=num_resamples, level=level)


def median_steps(steps: Sequence[int | None]) -> float | None:
    """Return the median of the env steps that several seeds took to reach a goal.

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
    """Return a warning about an interval over this many seeds, or an empty string if none is needed."""
    if num_values < 2:
        return "one seed: no interval"
    if num_values < MIN_SEEDS_FOR_INTERVAL:
        return f"{num_values} seeds: the interval is too narrow"
    return ""


def _finite_1d(values: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1 or array.size == 0:
        raise ValueError(f"expected a 1-D, non-empty array, got shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{int((~np.isfinite(array)).sum())} of {array.size} values are not finite")
    return array

"""An estimate with its interval, and what arguments of statistics must be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Values: TypeAlias = Sequence[float] | NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """An estimate with its interval, in the units of the values."""

    mean: float
    """The estimate: a mean, an interquartile mean or, of yes-or-no values, a share."""
    lower: float
    upper: float
    num_values: int
    note: str = ""
    """Why the interval is to be read with care, for a reader; empty if it isn't."""


def finite_1d(values: Values, where: str = "") -> NDArray[np.float64]:
    """Return the values as an array.

    Args:
        values: Numbers, shape (n,).
        where: What they are, for the message, as in "settings[3]".

    Raises:
        ValueError: There is no value, the array is not 1-D, or a value is not finite.
    """
    array = np.asarray(values, dtype=np.float64)
    place = f"{where}: " if where else ""
    if array.ndim != 1 or array.size == 0:
        raise ValueError(f"{place}expected a 1-D, non-empty array, got shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{place}{int((~np.isfinite(array)).sum())} of {array.size} values are not finite")
    return array


def finite_arrays(groups: Sequence[Values], where: str) -> list[NDArray[np.float64]]:
    """Return several lists of values, such as the seeds of each setting, as arrays.

    Raises:
        ValueError: There is no list, or one of them is not as `finite_1d` wants it.
    """
    if not len(groups):
        raise ValueError(f"{where} is empty")
    return [finite_1d(values, f"{where}[{index}]") for index, values in enumerate(groups)]


def check_level(level: float) -> float:
    """Return the level of an interval.

    Raises:
        ValueError: It is not in (0, 1).
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level {level} is not in (0, 1)")
    return level


def check_count(count: int, what: str) -> int:
    """Return how many resamples or draws are made.

    Raises:
        ValueError: It is less than 1.
    """
    if count < 1:
        raise ValueError(f"{what} {count} is less than 1")
    return count


def exponent_of(values: Values) -> int:
    """Return the least n for which all values, divided by 2 to the power n, lie within -1 and 1.

    To divide by a power of two rounds nothing, and sums and squares of the quotients don't overflow.
    """
    return int(np.frexp(np.abs(values).max())[1])


def mean_of(values: NDArray[np.float64]) -> float:
    """Return the mean of values, shape (n,), also where their sum is too large for a float."""
    exponent = exponent_of(values)
    return float(np.ldexp(np.ldexp(values, -exponent).mean(), exponent))


def variance(values: NDArray[np.float64]) -> float:
    """Return the unbiased variance of two values or more; exactly 0 where all are equal, which rounding may hide."""
    return 0.0 if values.min() == values.max() else float(values.var(ddof=1))

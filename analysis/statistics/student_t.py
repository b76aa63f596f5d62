"""Quantiles of Student's t, also for fractional degrees of freedom, so that no run needs SciPy for them."""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist

_TINY = 1e-300
_NEARLY_NORMAL = 1e5


def normal_quantile(probability: float) -> float:
    """Return the value that a standard normal variable stays below with this probability, in (0, 1).

    Raises:
        ValueError: The probability is not in (0, 1).
    """
    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability {probability} is not in (0, 1)")
    return NormalDist().inv_cdf(probability)


def normal_tail(value: float) -> float:
    """Return the probability that a standard normal variable is above this value."""
    return 0.5 * math.erfc(value / math.sqrt(2.0))


@lru_cache(maxsize=1024)
def t_quantile(probability: float, df: float) -> float:
    """Return the value that a t-distributed variable stays below with this probability.

    Args:
        probability: In (0, 1).
        df: Degrees of freedom, at least 1, whole or not; infinity gives the normal quantile.

    Raises:
        ValueError: The probability is not in (0, 1), or the degrees of freedom are less than 1 or NaN.

    Source:
        Abramowitz & Stegun 1964, 26.7.1 (the distribution) and 26.7.5 (the series for many degrees of freedom).
    """
    if not df >= 1.0:
        raise ValueError(f"{df} degrees of freedom are less than 1")
    normal = normal_quantile(probability)
    if df > _NEARLY_NORMAL:
        return normal + (normal**3 + normal) / (4.0 * df)
    if probability < 0.5:
        return -t_quantile(1.0 - probability, df)
    upper_tail = 1.0 - probability
    low, high = 0.0, 1.0
    while _upper_tail(high, df) > upper_tail:
        low, high = high, 2.0 * high
    while (middle := (low + high) / 2.0) not in (low, high):
        low, high = (middle, high) if _upper_tail(middle, df) > upper_tail else (low, middle)
    return low


def _upper_tail(value: float, df: float) -> float:
    """Return P(T > value) of a value of at least 0."""
    # Of the two arguments that sum to 1, the one that was not made by a subtraction is exact.
    square = value * value
    return 0.5 * _incomplete_beta(df / 2.0, 0.5, df / (df + square), square / (df + square))


def _incomplete_beta(a: float, b: float, x: float, rest: float) -> float:
    """Return the regularised incomplete beta function I_x(a, b), where rest = 1 - x."""
    if x <= 0.0 or rest <= 0.0:
        return 0.0 if x <= 0.0 else 1.0
    log_front = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log(rest)
    # The fraction converges fast on one side of the mean; the other side is its mirror image.
    if x < (a + 1.0) / (a + b + 2.0):
        return math.exp(log_front) * _beta_fraction(a, b, x) / a
    return 1.0 - math.exp(log_front) * _beta_fraction(b, a, rest) / b


def _beta_fraction(a: float, b: float, x: float) -> float:
    """Return the continued fraction of I_x(a, b) by Lentz's method (Press et al. 2007, Numerical Recipes, 6.4)."""
    c, d = 1.0, 1.0 - (a + b) * x / (a + 1.0)
    d = 1.0 / (d or _TINY)
    result = d
    for m in range(1, 10_000):
        even = m * (b - m) * x / ((a + 2 * m - 1.0) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1.0))
        for term in (even, odd):
            d = 1.0 / ((1.0 + term * d) or _TINY)
            c = (1.0 + term / c) or _TINY
            result *= c * d
        if abs(c * d - 1.0) < 1e-15:
            break
    return result

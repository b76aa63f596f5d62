"""Env steps to a threshold, as a survival curve: trials that never reached it are censored, not dropped."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.estimate import check_level, finite_1d
from analysis.statistics.student_t import normal_quantile


@dataclass(frozen=True)
class SurvivalCurve:
    """The share of trials that have not reached a threshold yet, a step function of the env steps.

    It is 1 before the first of `steps`, and `shares[i]` from `steps[i]` to the next.
    """

    steps: NDArray[np.float64]
    """The env steps at which some trial reached the threshold, increasing, shape (E,); empty if none did."""
    shares: NDArray[np.float64]
    """The share that has not reached it at these env steps, shape (E,)."""
    lower: NDArray[np.float64]
    """The lower end of the pointwise interval, shape (E,)."""
    upper: NDArray[np.float64]
    """The upper end, shape (E,)."""
    num_at_risk: NDArray[np.int64]
    """How many trials were still training and had not reached it just before, shape (E,)."""
    num_reached: NDArray[np.int64]
    """How many reached it at these env steps, shape (E,)."""
    num_trials: int

    @property
    def median(self) -> float | None:
        """The first env steps by which at most half of the trials are left; None: more than half are, to the end."""
        return _first(self.steps, self.shares)

    @property
    def median_interval(self) -> tuple[float | None, float | None]:
        """The interval of the median, where the band crosses one half; None: not reached, so no bound is known.

        Source:
            Brookmeyer & Crowley 1982, "A Confidence Interval for the Median Survival Time".
        """
        return _first(self.steps, self.lower), _first(self.steps, self.upper)


def steps_to_threshold(
    reached: Sequence[float | None], num_env_steps: Sequence[float], *, level: float = 0.95
) -> SurvivalCurve:
    """Return the Kaplan-Meier curve of the env steps to a threshold.

    A trial that never reached the threshold counts as not having reached it as long as it trained, and is then taken
    out: it is not said that it never would. That is right for trials that ended by a budget, not for those an early
    stopping ended because they were bad: with these the curve falls too fast, unless they count with the env steps that
    they were to have.

    Args:
        reached: For each trial the env steps at which it reached the threshold; None: it never did (it is censored).
        num_env_steps: For each trial the env steps of its last evaluation, in the same order.
        level: The share of pointwise intervals that shall cover the truth, in (0, 1).

    Returns:
        The curve with intervals by Greenwood's variance of the logarithm of its logarithm, which stay within 0 and 1.
        Where no trial is left that variance is infinite; the interval is then from 0 to its last upper end.

    Raises:
        ValueError: There are no trials, the lengths differ, env steps are negative or not finite, a trial reached the
            threshold after its last env step, or the level is outside (0, 1).

    Source:
        Kaplan & Meier 1958, "Nonparametric Estimation from Incomplete Observations"; Kalbfleisch & Prentice 2002, "The
        Statistical Analysis of Failure Time Data", section 1.4 (intervals).
    """
    z = normal_quantile((1.0 + check_level(level)) / 2.0)
    last = finite_1d(num_env_steps, "num_env_steps")
    if len(reached) != last.size:
        raise ValueError(f"{len(reached)} trials in reached, but {last.size} in num_env_steps")
    events = finite_1d([end if step is None else step for step, end in zip(reached, last, strict=True)], "reached")
    if events.min() < 0.0 or last.min() < 0.0:
        raise ValueError("env steps are negative")
    if (events > last).any():
        trial = int((events > last).argmax())
        raise ValueError(f"trial {trial} reached the threshold at {events[trial]:g}, after its last {last[trial]:g}")
    happened = np.array([step is not None for step in reached])
    steps, num_reached = np.unique(events[happened], return_counts=True)
    at_risk = events.size - np.searchsorted(np.sort(events), steps, side="left")
    shares: NDArray[np.float64] = np.cumprod(1.0 - num_reached / at_risk, dtype=np.float64)
    lower, upper = _bands(shares, num_reached, at_risk, z)
    return SurvivalCurve(steps, shares, lower, upper, at_risk, num_reached, events.size)


def _bands(
    shares: NDArray[np.float64], num_reached: NDArray[np.int64], at_risk: NDArray[np.int64], z: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ends of the log-log intervals, S^exp(-+z SE) with SE that of log(-log S)."""
    lower, upper = np.zeros_like(shares), np.ones_like(shares)
    greenwood, last_upper = 0.0, 1.0
    for index, (share, count, risk) in enumerate(zip(shares, num_reached, at_risk, strict=True)):
        # With nobody left the variance is infinite.
        if count < risk:
            greenwood += count / (risk * (risk - count))
            error = math.sqrt(greenwood) / -math.log(share)
            lower[index], last_upper = share ** math.exp(z * error), share ** math.exp(-z * error)
        upper[index] = last_upper
    return lower, upper


def _first(steps: NDArray[np.float64], shares: NDArray[np.float64]) -> float | None:
    """Return the first env steps at which a curve is at one half or below, rounding apart; None if nowhere."""
    below = np.flatnonzero(shares <= 0.5 + 1e-12)
    return float(steps[below[0]]) if below.size else None

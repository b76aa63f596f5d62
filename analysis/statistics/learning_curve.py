"""One trial's learning curve: the area under it, and whether it collapsed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.estimate import Values, exponent_of, finite_1d


def area_under_curve(
    env_steps: Values,
    returns: Values,
    *,
    num_env_steps: float | None = None,
    initial_return: float | None = None,
) -> float:
    """Return the area under the curve of evaluation returns, divided by the env steps: a mean return over training.

    The curve is straight from one evaluation to the next (trapezoids). It begins at 0 env steps and ends at
    `num_env_steps`, whatever a trial evaluated:

    - Before the first evaluation it goes from `initial_return` to it. Where that isn't known it is level: the first
      evaluation is taken to hold from the start, which flatters a trial that evaluates late.
    - After the last evaluation it is level: a trial that ended because it solved the task keeps its score. One that
      failed or was stopped early is flattered by that; compare trials of one budget, or cut all at the least.
    - Evaluations after `num_env_steps` count only as far as the curve leads to them.

    Args:
        env_steps: Env steps of the evaluations, increasing, none negative, shape (E,).
        returns: Mean return of each evaluation, shape (E,).
        num_env_steps: The env steps to average over; None: up to the last evaluation.
        initial_return: The return before training, such as a random policy's; None: not known.

    Returns:
        The area in units of the return. Of a single evaluation at 0 env steps it is that evaluation.

    Raises:
        ValueError: There are no evaluations, the lengths differ, a value is not finite, env steps don't increase or are
            negative, or `num_env_steps` is not above 0 though there are evaluations above 0.
    """
    steps, values = _curve(env_steps, returns)
    if initial_return is not None and steps[0] > 0.0:
        start = finite_1d([initial_return], "initial_return")
        steps, values = np.concatenate([[0.0], steps]), np.concatenate([start, values])
    end = float(steps[-1]) if num_env_steps is None else float(finite_1d([num_env_steps], "num_env_steps")[0])
    if end <= 0.0:
        if end == 0.0 == steps[-1]:
            return float(values[0])
        raise ValueError(f"cannot average a learning curve over {end:g} env steps")
    # numpy.interp holds the outermost values.
    places = np.concatenate([[0.0], steps[(steps > 0.0) & (steps < end)], [end]])
    exponent = exponent_of(values)
    heights = np.interp(places, steps, np.ldexp(values, -exponent))
    return float(np.ldexp(((heights[1:] + heights[:-1]) / 2.0 * np.diff(places)).sum() / end, exponent))


def share_lost(returns: Values, *, baseline: float | None = None, num_last: int = 1) -> float | None:
    """Return how much of what a trial had learnt it lost: (best - last) / (best - baseline).

    0: it ended at its best; 1: it ended where it began; more: below. The best of many noisy evaluations is a lucky one,
    so a trial that learnt little lost a good part of it by this measure.

    Args:
        returns: Mean return of each evaluation, in the order of training, shape (E,).
        baseline: The return of a policy that learnt nothing, such as a random one's; None: the first evaluation.
        num_last: Of how many of the last evaluations the mean is compared with the best.

    Returns:
        The share, or None if no evaluation is above the baseline: there was nothing to lose. So it is for one
        evaluation without a baseline, and for constant returns.

    Raises:
        ValueError: There is no evaluation, a value is not finite, or `num_last` is not from 1 to their number.
    """
    values = finite_1d(returns, "returns")
    if not 1 <= num_last <= values.size:
        raise ValueError(f"num_last {num_last} is not from 1 to {values.size}, the number of evaluations")
    start = values[0] if baseline is None else finite_1d([baseline], "baseline")[0]
    best = values.max()
    if best <= start:
        return None
    return float((best - values[-num_last:].mean()) / (best - start))


def has_collapsed(
    returns: Values, *, share: float = 0.5, baseline: float | None = None, num_last: int = 1
) -> bool | None:
    """Return whether a trial lost more than this share of what it had learnt, by the end.

    Args:
        returns: Mean return of each evaluation, in the order of training, shape (E,).
        share: How much it may lose, of (best - baseline), in (0, 1].
        baseline: As in `share_lost`.
        num_last: As in `share_lost`.

    Returns:
        Whether it did; None if it never was above the baseline, so that nothing could be lost.

    Raises:
        ValueError: The share is not in (0, 1], or in the cases of `share_lost`.
    """
    if not 0.0 < share <= 1.0:
        raise ValueError(f"share {share} is not in (0, 1]")
    lost = share_lost(returns, baseline=baseline, num_last=num_last)
    return None if lost is None else lost > share


def _curve(env_steps: Values, returns: Values) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    steps, values = finite_1d(env_steps, "env_steps"), finite_1d(returns, "returns")
    if steps.size != values.size:
        raise ValueError(f"{steps.size} env steps, but {values.size} returns")
    if steps[0] < 0.0 or (np.diff(steps) <= 0.0).any():
        raise ValueError("the env steps of evaluations are negative or don't increase")
    return steps, values

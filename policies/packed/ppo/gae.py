"""Generalised advantage estimation for many members at once.

Source: Schulman et al. 2016, "High-dimensional continuous control using generalised advantage estimation", equation 16.

Shapes: T vector steps, S sub-environments of all members.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


def advantages_and_targets(
    rewards: Floats,
    values: Floats,
    next_values: Floats,
    *,
    terminated: NDArray[np.bool_],
    ended: NDArray[np.bool_],
    gamma: Floats,
    gae_lambda: Floats,
) -> tuple[Floats, Floats]:
    """Compute advantages, not standardised, and value targets.

    Args:
        rewards: The rewards, (T, S).
        values: V of the observation that was acted on, (T, S).
        next_values: V of the observation after the step, before any reset, (T, S). It is bootstrapped from where an
            episode is cut off by its time limit or by the end of the fragment; values at terminated steps are ignored.
        terminated: Whether the step terminated its episode, (T, S).
        ended: Whether the step terminated or truncated its episode, (T, S); no advantage flows back over the end.
        gamma: Discount factors, (S,).
        gae_lambda: Lambdas of the estimation, (S,).

    Returns:
        Advantages and value targets, each of shape (T, S).
    """
    residuals = rewards + np.where(terminated, np.float32(0.0), gamma * next_values) - values
    decay = np.where(ended, np.float32(0.0), gamma * gae_lambda)
    advantages = np.empty_like(residuals)
    running = np.zeros_like(residuals[0])
    for step in range(len(residuals) - 1, -1, -1):
        running = residuals[step] + decay[step] * running
        advantages[step] = running
    return advantages, advantages + values


def standardise(advantages: Floats) -> Floats:
    """Scale each row, (M, R), to mean 0 and standard deviation 1, as RLlib does: a deviation is at least 1e-4."""
    # NumPy sums a row in another order where it does not lie in one piece, as rows of packs with one env each may not.
    advantages = np.ascontiguousarray(advantages)
    mean = advantages.mean(axis=1, keepdims=True)
    std = advantages.std(axis=1, keepdims=True)
    out: Floats = ((advantages - mean) / np.maximum(std, np.float32(1e-4))).astype(np.float32)
    return out

"""Normalise rewards by the running statistics of the discounted return.

Sources: `VecNormalize(norm_reward=True)` of Stable-Baselines3 and `NormalizeReward` of Gymnasium, both after OpenAI
Baselines; Engstrom et al. 2020, "Implementation Matters in Deep RL: A Case Study on PPO and TRPO", section 3, "reward
scaling". The running variance is that of Chan et al. 1979, "Updating Formulae and a Pairwise Algorithm for Computing
Sample Variances".

With R_t = r_t + gamma R_(t-1) in each sub-environment, and R_(t-1) = 0 at the start of an episode, a reward becomes

    clip(r_t / sqrt(var(R) + 1e-8), -10, 10)

where var(R) is over all R of all sub-environments since the start of training. The mean is not taken off: that would
change which policy is best. Stable-Baselines3 and Gymnasium update the variance at every step; here all rewards of an
iteration are divided by the same number, the deviation after the iteration's last step, so that no batch has rewards of
different scales, however many env runners sample it. After each iteration the statistics are the same. Gymnasium's
wrapper does not begin anew at a truncation, and carries an episode's last reward over; as in Stable-Baselines3, that is
not so here.

Shapes: T steps, N sub-environments.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

REWARD_CLIP = 10.0
"""Normalised rewards are clipped at -/+ this, as Stable-Baselines3 does by default."""
VARIANCE_EPSILON = 1e-8
FIRST_COUNT = 1e-4
"""The weight of the first mean, 0, and the first variance, 1, in values; as in both sources."""


@dataclass
class ReturnStatistics:
    """The running mean and variance of the discounted return."""

    mean: float = 0.0
    var: float = 1.0
    count: float = FIRST_COUNT
    """The number of values so far, and the weight of the first mean and variance."""

    def add(self, returns: NDArray[np.float64]) -> None:
        """Add discounted returns of any shape."""
        num_new = returns.size
        if not num_new:
            return
        mean, var = float(returns.mean()), float(returns.var())
        total = self.count + num_new
        delta = mean - self.mean
        squares = self.var * self.count + var * num_new + delta**2 * (self.count * num_new / total)
        self.mean += delta * (num_new / total)
        self.var, self.count = squares / total, total

    def scale(self, rewards: NDArray[Any]) -> NDArray[np.float32]:
        """Return rewards divided by the return's standard deviation, and clipped."""
        scaled = np.asarray(rewards, dtype=np.float64) / np.sqrt(self.var + VARIANCE_EPSILON)
        return np.asarray(np.clip(scaled, -REWARD_CLIP, REWARD_CLIP), dtype=np.float32)


def discounted_returns(
    rewards: NDArray[Any], ended: NDArray[np.bool_], gamma: float, before: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Accumulate the discounted return R_t = r_t + gamma R_(t-1) of some steps.

    Args:
        rewards: The rewards, (T, N).
        ended: Whether each step ended its episode, by termination or truncation, (T, N).
        gamma: The discount factor.
        before: R of the step before the first, (N,); 0 where an episode begins.

    Returns:
        R of each step, (T, N), and R of the last step for the next call, (N,), which is 0 where an episode has ended.
    """
    returns = np.empty(rewards.shape, dtype=np.float64)
    running = before
    for step in range(len(rewards)):
        returns[step] = rewards[step] + gamma * running
        running = np.where(ended[step], 0.0, returns[step])
    return returns, running

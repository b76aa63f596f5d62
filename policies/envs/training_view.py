"""What training alone sees of a vector environment; evaluations and reported returns never do."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray


class TrainingView(gym.vector.VectorWrapper):
    """The outermost wrapper of a vector environment whose rewards or ends differ for the learner.

    Its `step` returns the learner's rewards, and the environment's own ends.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        self.own_rewards: NDArray[Any] = np.zeros(env.num_envs)
        """The environment's own rewards of the last step, shape (num_envs,). Reported returns are their sums."""
        self.lost_lives: NDArray[np.bool_] | None = None
        """Where the last step is an end for the learner, but the episode goes on, shape (num_envs,); None: nowhere."""

"""The project's environment, which needs a helper from beside it."""

from typing import Any

import gymnasium as gym
import numpy as np
from analysis.rewards import reward_of
from numpy.typing import NDArray


class Walk(gym.Env[NDArray[np.float32], np.int64]):
    """Ten steps; only the action 1 is rewarded."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012
    observation_space = gym.spaces.Box(0, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self._num_steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        self._num_steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action: np.int64) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        self._num_steps += 1
        observation = np.full(2, self._num_steps / 10, np.float32)
        return observation, reward_of(action), False, self._num_steps >= 10, {}

    def render(self) -> Any:
        return np.zeros((32, 32, 3), np.uint8)

"""An environment whose work is to wait, so that many trials can be at work at once on few cores."""

from __future__ import annotations

import time
from typing import Any

import gymnasium as gym
import numpy as np

NUM_STEPS = 4
"""Steps of an episode."""


class Asleep(gym.Env[Any, Any]):
    """Episodes of `NUM_STEPS` steps, each of which takes `step_s` seconds of waiting and next to no CPU time.

    Args:
        step_s: Seconds.
    """

    def __init__(self, step_s: float = 0.0) -> None:
        self.observation_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.action_space = gym.spaces.Discrete(2)
        self._step_s, self._num_steps = step_s, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self._num_steps = 0
        return np.zeros(4, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        time.sleep(self._step_s)
        self._num_steps += 1
        return np.zeros(4, np.float32), float(action), self._num_steps >= NUM_STEPS, False, {}


gym.register("BenchmarksAsleep-v0", entry_point="tests.benchmarks.cluster.asleep:Asleep")

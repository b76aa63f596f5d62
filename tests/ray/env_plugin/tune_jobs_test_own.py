"""A module of a user's own with an environment, which nothing registers but importing it."""

import os
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray


class Edge(gym.Env[NDArray[np.float32], np.int64]):
    """Walk on five tiles; falling over the left edge is failure, whoever stays is rewarded with 1 a step.

    Its first observation tells where it is, in [-1, 1].
    """

    metadata = {"render_modes": ["rgb_array"], "failure": "terminated"}  # noqa: RUF012

    def __init__(self, *, limit: int = 12, render_mode: str | None = None) -> None:
        self.limit, self.render_mode = limit, render_mode
        self.observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = gym.spaces.Discrete(2)
        self.tile = self.ticks = 0

    def _observation(self) -> NDArray[np.float32]:
        return np.array([(self.tile - 2) / 3, 1.0], np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        self.tile, self.ticks = int(self.np_random.integers(5)), 0
        return self._observation(), {}

    def step(self, action: np.int64) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        self.tile, self.ticks = min(4, self.tile + (1 if action else -1)), self.ticks + 1
        return self._observation(), 1.0, self.tile < 0, self.ticks >= self.limit, {}

    def render(self) -> Any:
        picture = np.zeros((32, 80, 3), np.uint8)
        picture[:, 16 * max(self.tile, 0) : 16 * max(self.tile, 0) + 16] = 255
        return picture


class SlowEdge(Edge):
    """The same with steps of two milliseconds; each copy writes down which process it is in, and that one's parent."""

    def __init__(self, *, pids: str | None, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.pids = pids

    def step(self, action: np.int64) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        if self.pids is not None:
            with Path(self.pids).open("a") as file:
                file.write(f"{os.getpid()} {os.getppid()}\n")
            self.pids = None
        time.sleep(0.002)
        return super().step(action)


class OneEdge(Edge):
    """The same, of which a process can hold one only."""

    made = 0

    def __init__(self, **kwargs: Any) -> None:
        if OneEdge.made:
            raise RuntimeError("Cannot create multiple edges per process")
        OneEdge.made = 1
        super().__init__(**kwargs)

    def close(self) -> None:
        OneEdge.made = 0


if "TestEdge-v0" not in gym.registry:
    # Gymnasium's type asks for a class that takes any keywords.
    gym.register("TestEdge-v0", Edge, reward_threshold=11.5)  # type: ignore[arg-type]

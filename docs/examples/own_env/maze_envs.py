"""An environment of one's own: walk over a square of tiles to the corner where the exit is."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))
"""Down, up, right, left."""


class Maze(gymnasium.Env[NDArray[np.float32], int]):
    """The exit gives 1, each step costs 0.02; an episode begins on any other tile.

    Args:
        size: Tiles along each side.
        render_mode: `rgb_array`, for videos.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 8}

    def __init__(self, size: int = 5, render_mode: str | None = None) -> None:
        self.size, self.render_mode = size, render_mode
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (2,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(len(STEPS))
        self.row = self.column = self.num_steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode. All chance comes from `np_random`, so that a seed fixes it."""
        super().reset(seed=seed, options=options)
        self.row, self.column = divmod(int(self.np_random.integers(self.size**2 - 1)), self.size)
        self.num_steps = 0
        return self._observation(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Go one tile further, if there is one."""
        down, right = STEPS[action]
        self.row = min(max(self.row + down, 0), self.size - 1)
        self.column = min(max(self.column + right, 0), self.size - 1)
        self.num_steps += 1
        at_exit = self.row == self.column == self.size - 1
        too_long = self.num_steps >= 10 * self.size
        return self._observation(), 0.98 if at_exit else -0.02, at_exit, too_long, {}

    def render(self) -> Any:
        """A picture: the exit is green, the walker white."""
        picture = np.zeros((self.size, self.size, 3), np.uint8)
        picture[-1, -1] = (0, 160, 0)
        picture[self.row, self.column] = 255
        return picture.repeat(32, axis=0).repeat(32, axis=1)

    def _observation(self) -> NDArray[np.float32]:
        return np.array([self.row, self.column], np.float32) / np.float32(self.size - 1)


# With a threshold, reports say whether a policy solves it. `env: maze_envs:Maze` does without this.
gymnasium.register("Maze-v0", Maze, reward_threshold=0.9)  # type: ignore[arg-type]

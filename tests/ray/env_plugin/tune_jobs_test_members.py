"""Images among other members of what is observed."""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray


class Beside(gym.Env[Any, Any]):
    """Noise that is brighter in one half of an image, and a choice: the right action tells whether both are the same.

    Who sees one of them is right half of the time. There are numbers without meaning before and behind the image.

    Args:
        as_bytes: Whether pixels are bytes, or numbers from 0 to 1.
        is_masked: Whether each action has two numbers, of which a mask allows one; a forbidden one raises an error.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, *, as_bytes: bool = True, is_masked: bool = False) -> None:
        kind = (0, 255, np.uint8) if as_bytes else (0.0, 1.0, np.float32)
        self._image = gym.spaces.Box(kind[0], kind[1], (12, 9, 2), kind[2])
        members: dict[str, Any] = {
            "before": gym.spaces.Box(-1.0, 1.0, (3,), np.float32),
            "image": self._image,
            "which": gym.spaces.Discrete(2),
        }
        if is_masked:
            members = {"action_mask": gym.spaces.MultiBinary(4), **members}
        self.observation_space = gym.spaces.Dict(members)
        self.action_space = gym.spaces.Discrete(4 if is_masked else 2)
        self.is_masked, self.right, self.ticks = is_masked, 0, 0
        self.mask: NDArray[np.int8] = np.ones(4, np.int8)

    def _observation(self) -> dict[str, Any]:
        half, which = (int(number) for number in self.np_random.integers(2, size=2))
        self.right = int(half == which)
        image = self.np_random.uniform(0.0, 0.5, self._image.shape)
        image[6 * half : 6 * (half + 1)] += 0.5
        first = self.np_random.integers(0, 2, 2)
        self.mask = np.array([first[0], first[1], 1 - first[0], 1 - first[1]], np.int8)
        return {
            **({"action_mask": self.mask} if self.is_masked else {}),
            "before": self.np_random.uniform(-1.0, 1.0, 3).astype(np.float32),
            "image": (image * self._image.high.max()).astype(self._image.dtype),
            "which": np.int64(which),
        }

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.ticks = 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self.is_masked and not self.mask[action]:
            raise RuntimeError(f"the action {action} is forbidden by {self.mask}")
        self.ticks += 1
        reward = float(action % 2 == self.right)
        return self._observation(), reward, self.ticks >= 10, False, {}


class Pair(Beside):
    """Two images of one size: the right action tells whether their brighter halves are the same.

    Who sees one of them is right half of the time. One is of bytes and the other of numbers from 0 to 1, with numbers
    without meaning before, between and behind them.
    """

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = gym.spaces.Dict(
            {
                "a_die": gym.spaces.Discrete(2),
                "color": self._image,
                "counts": gym.spaces.Box(-1.0, 1.0, (3,), np.float32),
                "depth": gym.spaces.Box(0.0, 1.0, (12, 9, 1), np.float32),
                "digit": gym.spaces.Discrete(3),
            }
        )

    def _observation(self) -> dict[str, Any]:
        half, other = (int(number) for number in self.np_random.integers(2, size=2))
        self.right = int(half == other)
        color, depth = self.np_random.uniform(0.0, 0.5, (12, 9, 2)), self.np_random.uniform(0.0, 0.5, (12, 9, 1))
        color[6 * half : 6 * (half + 1)] += 0.5
        depth[6 * other : 6 * (other + 1)] += 0.5
        return {
            "a_die": self.np_random.integers(2),
            "color": (color * 255).astype(np.uint8),
            "counts": self.np_random.uniform(-1.0, 1.0, 3).astype(np.float32),
            "depth": depth.astype(np.float32),
            "digit": self.np_random.integers(3),
        }


class FineBeside(Beside):
    """The same of numbers from 0 to 1."""

    def __init__(self) -> None:
        super().__init__(as_bytes=False)


class MaskedBeside(Beside):
    """The same with a mask."""

    def __init__(self) -> None:
        super().__init__(is_masked=True)

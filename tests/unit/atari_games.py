"""A game with what Atari's have: an emulator with lives and screens, `frameskip`, and action meanings.

It needs no emulator to be installed, so what is around a game is tested everywhere.
"""

import importlib.util
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

ID = "TestAtari-v0"
needs_opencv = importlib.util.find_spec("cv2") is None
NO_OPENCV = "OpenCV is not installed (pip install 'tune-jobs[atari]')"
LIFE_FRAMES, LIVES = 10, 3
"""A life is lost after so many frames, the game over with the third one."""


class Emulator:
    def __init__(self) -> None:
        self.frame = 0

    def lives(self) -> int:
        return LIVES - self.frame // LIFE_FRAMES

    def screen(self) -> NDArray[np.uint8]:
        """Brighter from frame to frame; odd frames lack what even ones have on the left, and the other way round."""
        picture = np.full((210, 160), self.frame, np.uint8)
        picture[:, :80] += np.uint8(100 * (self.frame % 2))
        picture[:, 80:] += np.uint8(100 * (1 - self.frame % 2))
        return picture

    def getScreenGrayscale(self, into: NDArray[np.uint8]) -> None:  # noqa: N802 (the emulator's name)
        into[...] = self.screen()


class Game(gym.Env[Any, Any]):
    """A frame pays 1, but -1 from the 5th to the 8th; each life has ten frames."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012

    def __init__(
        self, frameskip: int = 4, obs_type: str = "rgb", max_num_frames_per_episode: int = 400,
        render_mode: str | None = None,
    ) -> None:  # fmt: skip
        self.ale, self._frameskip, self.render_mode = Emulator(), frameskip, render_mode
        shape = (210, 160) if obs_type == "grayscale" else (210, 160, 3)
        self.observation_space = gym.spaces.Box(0, 255, shape, np.uint8)
        self.action_space = gym.spaces.Discrete(3)

    def get_action_meanings(self) -> list[str]:
        return ["NOOP", "LEFT", "RIGHT"]

    def _seen(self) -> NDArray[np.uint8]:
        return np.zeros(self.observation_space.shape or (), np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.ale.frame = 0
        return self._seen(), {"lives": LIVES}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        total = 0.0
        for _ in range(self._frameskip):
            self.ale.frame += 1
            total += -1.0 if 5 <= self.ale.frame <= 8 else 1.0
        return self._seen(), total, self.ale.lives() <= 0, False, {"lives": self.ale.lives()}

    def render(self) -> Any:
        return np.repeat(self.ale.screen()[..., None], 3, axis=-1)


def register() -> None:
    if ID not in gym.registry:
        gym.register(ID, Game, kwargs={"max_num_frames_per_episode": 40})  # type: ignore[arg-type]

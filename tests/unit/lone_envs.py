"""Environments that want a process each, and what may go wrong there; child processes find them as `lone_envs:Name`."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from numpy.typing import NDArray

_alive: list[Lone] = []


class Lone(gym.Env[Any, Any]):
    """A walk to the right, of which a process can hold one only; it ends after some steps."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 7, "failure": "terminated"}  # noqa: RUF012 (Gymnasium's)
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Discrete(3)

    def __init__(self, length: int = 9, render_mode: str | None = None, last_words: str | None = None) -> None:
        if _alive:
            raise RuntimeError("Cannot create multiple instances per process")
        _alive.append(self)
        self.length, self.render_mode, self.last_words = length, render_mode, last_words

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.normal(size=2).astype(np.float32), 0
        return self.place.copy(), {"pid": os.getpid(), "options": options, "threads": os.environ.get("OMP_NUM_THREADS")}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.place[0] += action - 1
        self.steps += 1
        return self.place.copy(), float(action - 1), self.steps == self.length, False, {}

    def render(self) -> Any:
        return np.full((20, 30, 3), self.steps, np.uint8)

    def close(self) -> None:
        _alive.remove(self)
        if self.last_words is not None:
            Path(self.last_words).write_text("closed")

    def skip(self, steps: int, *, back: int = 0) -> int:
        """Let some steps pass, but for those back."""
        self.steps += steps - back
        return self.steps

    def action_masks(self) -> NDArray[np.bool_]:
        """Only a step to the right is allowed at first."""
        return np.array([self.steps > 0, self.steps > 0, True])

    @property
    def broken(self) -> NoReturn:
        """A property that raises an error."""
        raise ZeroDivisionError("it is broken")


class AsksForState(Lone):
    """Its mask is an info; a method of the same name needs the state, as Taxi's does."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return super().reset(seed=seed)[0], {"mask": self.mask(self.steps)}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return *super().step(action)[:4], {"mask": self.mask(self.steps)}

    def mask(self, state: int, *, sure: bool = True) -> NDArray[np.bool_]:
        """What is allowed in a state."""
        return np.array([state > 0, state > 0, sure])


class Behind(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper around the walk, which is an environment class, too."""

    def __init__(self) -> None:
        super().__init__(Lone())


class Pole(CartPoleEnv):
    """CartPole by another name; its arguments have the names of ours."""

    def __init__(
        self, *, env_id: str = "", name: str = "", make: str = "", creator: str = "", render_mode: str | None = None
    ) -> None:
        super().__init__(render_mode=render_mode)
        self.given = [env_id, name, make, creator]


class SelfMadeError(Exception):
    """An error that can't be made again of what it says."""

    def __init__(self, code: int, *, name: str) -> None:
        super().__init__(f"{name} {code}")


class Failing(Lone):
    """It fails in its constructor, its reset or a step, in some way."""

    def __init__(self, where: str, how: str) -> None:
        super().__init__()
        self.where, self.how = where, how
        self._fail("constructor")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._fail("reset")
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._fail("step")
        observation, *rest, info = super().step(action)
        return observation, *rest, info | ({"function": lambda: None} if self.how == "sends a function" else {})

    def _fail(self, where: str) -> None:
        if where != self.where:
            return
        if self.how == "divides":
            _ = 1 / 0
        if self.how == "own error":
            raise SelfMadeError(3, name="code")
        if self.how == "exits":
            raise SystemExit(5)
        if self.how == "ends":
            os._exit(7)
        if self.how == "is killed":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.how == "hangs":
            time.sleep(3600)


class EndsOnce(Lone):
    """Its process ends in the step that finds a file, which it takes away: so one process ends, and no other."""

    def __init__(self, at: str) -> None:
        super().__init__(length=3)
        self.at = Path(at)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self.at.exists():
            self.at.unlink()
            os._exit(139)
        return super().step(action)

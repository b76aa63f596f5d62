"""Environments that misbehave; child processes find them as `odd_envs:Name`."""

from __future__ import annotations

import json
import multiprocessing
import os
import tempfile
import time
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

RAISE, EXIT, WRONG_SHAPE = 1, 2, 3


class Fragile(gym.Env[Any, Any]):
    """A random walk that goes on by action 0; by the others it breaks. It ends after 7 steps."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Discrete(4)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.state, self.steps = self.draw(), 0
        return self.state.copy(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if action == RAISE:
            raise RuntimeError("the motor broke")
        if action == EXIT:
            os._exit(7)
        self.state += 0.1 * self.draw()
        self.steps += 1
        observation = np.zeros(5) if action == WRONG_SHAPE else self.state.copy()
        return observation, float(self.state.sum()), self.steps == 7, False, {}

    def draw(self) -> NDArray[np.float64]:
        return self.np_random.normal(size=2)


class Slow(Fragile):
    """Two milliseconds a step."""

    action_space = gym.spaces.Discrete(1)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        time.sleep(0.002)
        return super().step(action)


class Unseedable(Fragile):
    """Forgets its seed."""

    action_space = gym.spaces.Discrete(1)

    def draw(self) -> NDArray[np.float64]:
        return np.random.default_rng().normal(size=2)


class ForgetsLater(Fragile):
    """Takes another generator in each reset that has no seed."""

    action_space = gym.spaces.Discrete(1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.generator = np.random.default_rng(seed)
        return super().reset(seed=seed)

    def draw(self) -> NDArray[np.float64]:
        return self.generator.normal(size=2)


_shared = np.random.default_rng(0)


class Sharing(Fragile):
    """All copies draw from one generator, which whoever has a seed seeds."""

    action_space = gym.spaces.Discrete(1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        global _shared  # noqa: PLW0603
        if seed is not None:
            _shared = np.random.default_rng(seed)
        return super().reset(seed=seed)

    def draw(self) -> NDArray[np.float64]:
        return _shared.normal(size=2)


class RefusesSeeds(Fragile):
    """Cannot be reset from seed 13."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed == 13:
            raise ValueError("13 brings bad luck")
        return super().reset(seed=seed)


class Deep(Fragile):
    """Its error comes from what it calls."""

    def step(self, action: Any) -> Any:
        return self.parse("{")

    def parse(self, text: str) -> Any:
        return json.loads(text)


class OwnStop(BaseException):
    """What no `except Exception` takes."""


RAISED = {
    "SystemExit": SystemExit(3),
    "KeyboardInterrupt": KeyboardInterrupt(),
    "GeneratorExit": GeneratorExit("over"),
    "OwnStop": OwnStop("no further"),
}


class Faulty(Fragile):
    """What it does wrong is an argument, and where: in a method, or in the reward or observation of a step.

    Args:
        raises: A key of `RAISED`; None: nothing.
        where: `init`, `reset`, `step`, `close` or `render`; `reward` or `observation`.
        number: What it gives there: "nan", "inf" or "-inf", or any other.
        at: Step of an episode.
        action: Only a step by this action is wrong; None: any.
        seed: Only a reset from this seed, and what comes after it, is wrong; None: any.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    action_space = gym.spaces.Discrete(2)

    def __init__(  # noqa: PLR0917 (an env's arguments come by name)
        self,
        where: str = "step",
        raises: str | None = None,
        number: float | str | None = None,
        at: int = 3,
        action: int | None = None,
        seed: int | None = None,
        length: int = 7,
        render_mode: str | None = None,
    ) -> None:
        self.fault, self.raised, self.number = where, raises, None if number is None else float(number)
        self.at, self.action, self.wrong_seed, self.length = at, action, seed, length
        self.render_mode, self.steps, self.is_wrong = render_mode, 0, seed is None
        self.meet("init")

    def meet(self, where: str) -> None:
        if self.raised is not None and where == self.fault and self.is_wrong:
            raise RAISED[self.raised]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None and self.wrong_seed is not None:
            self.is_wrong = seed == self.wrong_seed
        self.meet("reset")
        observation, info = super().reset(seed=seed)
        return self.spoilt(observation, "reset"), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        is_now = self.steps == self.at and self.action in (None, action)
        if is_now:
            self.meet("step")
        self.state += 0.1 * self.draw()
        reward = float(self.state.sum())
        if is_now and self.is_wrong and self.fault == "reward":
            assert self.number is not None
            reward = self.number
        observation = self.state.copy()
        return self.spoilt(observation, "observation") if is_now else observation, reward, self.over, False, {}

    @property
    def over(self) -> bool:
        return self.steps == self.length

    def spoilt(self, observation: NDArray[np.float64], where: str) -> NDArray[np.float64]:
        if self.is_wrong and self.number is not None and self.fault == where:
            observation[1] = self.number
        return observation

    def render(self) -> Any:
        self.meet("render")
        return np.zeros((8, 8, 3), np.uint8)

    def close(self) -> None:
        self.meet("close")


class Images(gym.Env[Any, Any]):
    """Observes images, and cannot be drawn."""

    metadata = {"render_modes": []}  # noqa: RUF012
    observation_space = gym.spaces.Box(0, 255, (20, 16, 3), np.uint8)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return np.zeros((20, 16, 3), np.uint8), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.zeros((20, 16, 3), np.uint8), 0.0, True, False, {}


class Sized(gym.Env[Any, Any]):
    """Observes images of any shape, of bytes or of floating-point numbers without bounds."""

    action_space = gym.spaces.Discrete(2)

    def __init__(self, shape: Sequence[int], floats: bool = False) -> None:
        low, high = (-np.inf, np.inf) if floats else (0, 255)
        self.observation_space: Any = gym.spaces.Box(low, high, tuple(shape), np.float32 if floats else np.uint8)

    def seen(self) -> NDArray[Any]:
        return np.zeros(self.observation_space.shape, self.observation_space.dtype)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.seen(), 0.0, True, False, {}


class VerySlow(Fragile):
    """A quarter of a second a step."""

    action_space = gym.spaces.Discrete(1)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        time.sleep(0.25)
        return super().step(action)


class Patient(Fragile):
    """Takes its time; what an episode gives depends on its seed and on the actions.

    Args:
        step_s: Seconds that a step takes.
        pids: A file to which each object writes its process's id, when it is made.
        broken: With this seed, what it does in its first step: `raise`, `exit`, or `hang`.
        broken_seed: That seed.
    """

    action_space = gym.spaces.Discrete(2)

    def __init__(self, step_s: float = 0.0, pids: str = os.devnull, broken: str = "", broken_seed: int = -1) -> None:
        self.step_s, self.broken, self.broken_seed = step_s, broken, broken_seed
        with open(pids, "a") as file:  # noqa: PTH123 (the null device too)
            file.write(f"{os.getpid()}\n")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.is_broken = seed == self.broken_seed
        return super().reset(seed=seed)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        time.sleep(self.step_s)
        if self.is_broken:
            if self.broken == "hang":
                time.sleep(3600)
            return super().step({"raise": RAISE, "exit": EXIT}[self.broken])
        observation, reward, *rest = super().step(0)
        return observation, reward * (1 + int(action)), *rest


class EndsFor(Fragile):
    """Its process ends in the third step after a reset with one of the seeds from some number on."""

    action_space = gym.spaces.Discrete(2)

    def __init__(self, seed: int) -> None:
        self.bad, self.is_bad = seed, False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.is_bad = seed is not None and seed >= self.bad
        return super().reset(seed=seed)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return super().step(EXIT if self.is_bad and self.steps == 2 else 0)


class Accumulates(Fragile):
    """The reward of a step tells of all steps since it was made."""

    action_space = gym.spaces.Discrete(1)
    num_steps = 0

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.num_steps += 1
        observation, _, *rest = super().step(action)
        return observation, float(self.num_steps), *rest


class Scaled(gym.Wrapper[Any, Any, Any, Any]):
    """Rewards divided by what was seen of them before."""

    def __init__(self) -> None:
        super().__init__(gym.wrappers.NormalizeReward(Accumulates()))


class Helped(Fragile):
    """A process that it has forked helps it, and lives on for some seconds where its own ends."""

    helper: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if self.helper is None:
            self.helper = multiprocessing.get_context("fork").Process(target=time.sleep, args=(12,), daemon=True)
            self.helper.start()
        return super().reset(seed=seed)

    def close(self) -> None:
        if self.helper is not None:
            self.helper.terminate()


class Travels(Fragile):
    """Works in a folder of its own, which it removes as it closes."""

    action_space = gym.spaces.Discrete(1)

    def __init__(self, fails: bool = False) -> None:
        self.folder = tempfile.TemporaryDirectory()
        os.chdir(self.folder.name)
        if fails:
            self.close()
            raise RuntimeError("nothing to do here")

    def close(self) -> None:
        self.folder.cleanup()


class ClosesBadly(Fragile):
    """Closing it raises an error, once; it ends by failure."""

    metadata = {"failure": "terminated", "render_modes": []}  # noqa: RUF012 (Gymnasium's)
    is_closed = False

    def close(self) -> None:
        if not self.is_closed:
            self.is_closed = True
            raise RuntimeError("the window is gone")

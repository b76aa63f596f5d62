"""Small environments that go wrong on request, registered the way a user's package does it: by an entry point.

They are in a folder of their own, so that worker processes can import them from PYTHONPATH.
"""

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from tune_jobs_test_actions import Forbidding, ForbiddingTwo, Reply
from tune_jobs_test_members import Beside, FineBeside, MaskedBeside, Pair

# The block of seeds that belongs to one trial: those of its sub-environments.
SEEDS_PER_TRIAL = 1024


class Ticks(gym.Env[NDArray[np.float32], np.int64]):
    """The observation counts the steps of the episode; every number in it tells where it came from.

    An episode is terminated after `end` steps if it is given, and truncated by the time limit of its registration.
    The reward of step t of the episode with number k is t + k / 1000.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, *, end: int | None = None, start: int = 5) -> None:
        self.end = end
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.action_space = gym.spaces.Discrete(3, start=start)
        self.episode, self.ticks, self.stream = 0, 0, 0.0

    def _observation(self) -> NDArray[np.float32]:
        return np.array([self.ticks, self.episode, self.stream], np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.stream = float(self.np_random.normal())
        self.episode, self.ticks = self.episode + 1, 0
        return self._observation(), {}

    def step(self, action: np.int64) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        self.ticks += 1
        ended = self.end is not None and self.ticks >= self.end + self.episode % 3
        return self._observation(), self.ticks + self.episode / 1000, ended, False, {"ticks": self.ticks}


class Trouble(gym.Env[NDArray[np.float32], np.int64]):
    """A question a step (is the first number positive?), ten steps an episode; in some trials its step goes wrong.

    Args:
        troubles: First seed of a trial, as text -> what happens there: `how` (`raise`, `hang`, `exit`: the process
            dies, `SystemExit`: it is raised, or `nan`, `inf`, `-inf`: that is the reward), `at` (which step of this
            environment's life, over all its episodes) and `marker` (a file that is made when it happens; where it is
            there already, all is well).
        pause_s: Seconds that every step takes, in any trial.
        pause_while: A file: steps take them only while it is there; None: always.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        *,
        troubles: dict[str, dict[str, Any]] | None = None,
        pause_s: float = 0.0,
        pause_while: str | None = None,
    ) -> None:
        self.observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = gym.spaces.Discrete(2)
        self.troubles, self.pause_s, self.pause_while = troubles or {}, pause_s, pause_while
        self.trouble: dict[str, Any] | None = None
        self.life, self.ticks = 0, 0
        self.state = np.zeros(2, np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.trouble = self.troubles.get(str(seed - seed % SEEDS_PER_TRIAL))
        self.ticks = 0
        self.state = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.state, {}

    def step(self, action: np.int64) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        self.life += 1
        self.ticks += 1
        reward = None
        if self.trouble is not None and self.life >= self.trouble.get("at", 1):
            reward = self._go_wrong(**self.trouble)
        if self.pause_s and (self.pause_while is None or Path(self.pause_while).exists()):
            time.sleep(self.pause_s)
        if reward is None:
            reward = float(action == (self.state[0] > 0))
        self.state = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.state, reward, self.ticks >= 10, False, {}

    def _go_wrong(self, how: str, at: int = 1, marker: str | None = None) -> float | None:
        if marker is not None:
            if Path(marker).exists():
                return None
            Path(marker).touch()
        if how == "raise":
            raise ZeroDivisionError("the cart left the track")
        if how == "exit":
            os._exit(1)
        if how == "SystemExit":
            sys.exit("the cart has had enough")
        if how in ("nan", "inf", "-inf"):
            return float(how)
        # Not for ever, or a test of a broken watchdog would never end.
        time.sleep(120)
        raise TimeoutError("nothing ended the process")


class Laps(gym.Env[NDArray[np.float32], np.int64]):
    """Eight steps an episode, all episodes alike whatever their seeds; the reward is larger in later steps.

    Args:
        pause_s: Seconds that every step takes.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, *, pause_s: float = 0.0) -> None:
        self.observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = gym.spaces.Discrete(2)
        self.pause_s, self.ticks = pause_s, 0

    def _observation(self) -> NDArray[np.float32]:
        return np.array([np.cos(self.ticks), np.sin(self.ticks)], np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        self.ticks = 0
        return self._observation(), {}

    def step(self, action: np.int64) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        if self.pause_s:
            time.sleep(self.pause_s)
        reward = float(self.ticks**2) if action == self.ticks % 2 else -1.0
        self.ticks += 1
        return self._observation(), reward, self.ticks >= 8, False, {}


class Shades(gym.Env[NDArray[Any], Any]):
    """Images of noise, higher than they are wide; the right action tells in which half the noise is brighter.

    Args:
        as_bytes: Whether pixels are bytes, or numbers from 0 to 1.
        shape: (height, width, channels).
        num_pushes: For continuous actions of so many components, which are never right; None: two discrete ones.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self, *, as_bytes: bool = True, shape: Sequence[int] = (12, 9, 2), num_pushes: int | None = None
    ) -> None:
        kind = (0, 255, np.uint8) if as_bytes else (0.0, 1.0, np.float32)
        self.observation_space = gym.spaces.Box(kind[0], kind[1], tuple(shape), kind[2])
        self.action_space = (
            gym.spaces.Discrete(2) if num_pushes is None else gym.spaces.Box(-2.0, 2.0, (num_pushes,), np.float32)
        )
        self.right, self.ticks = 0, 0

    def _observation(self) -> NDArray[Any]:
        self.right = int(self.np_random.integers(2))
        image = self.np_random.uniform(0.0, 0.5, self.observation_space.shape)
        half = image.shape[0] // 2
        image[half * self.right : half * (self.right + 1)] += 0.5
        if self.observation_space.dtype == np.uint8:
            image *= 255
        return image.astype(self.observation_space.dtype)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        super().reset(seed=seed)
        self.ticks = 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        self.ticks += 1
        reward = float(isinstance(self.action_space, gym.spaces.Discrete) and action == self.right)
        return self._observation(), reward, self.ticks >= 10, False, {}


class Bits(Shades):
    """The same of zeros and ones, in bytes, as boards of games are; of the brighter half more are ones."""

    def __init__(self, *, shape: Sequence[int] = (12, 9, 2), highest: int = 1) -> None:
        super().__init__(shape=shape)
        self.observation_space = gym.spaces.Box(0, highest, tuple(shape), np.uint8)

    def _observation(self) -> NDArray[Any]:
        self.right = int(self.np_random.integers(2))
        chances = np.full(self.observation_space.shape or (), 0.3)
        half = chances.shape[0] // 2
        chances[half * self.right : half * (self.right + 1)] = 0.7
        return (self.np_random.random(chances.shape) < chances).astype(np.uint8)


class MaskedShades(Shades):
    """The same, where each action has two numbers, of which one is allowed at each step; the mask alone says which.

    A forbidden one raises an error. At the end nothing is allowed.
    """

    def __init__(self, *, as_bytes: bool = True, shape: Sequence[int] = (12, 9, 2)) -> None:
        super().__init__(as_bytes=as_bytes, shape=shape)
        self.action_space = gym.spaces.Discrete(4)
        self.mask: NDArray[np.int8] = np.ones(4, np.int8)

    def _observation(self) -> NDArray[Any]:
        image = super()._observation()
        first = self.np_random.integers(0, 2, 2)
        self.mask = np.array([first[0], first[1], 1 - first[0], 1 - first[1]], np.int8) * (self.ticks < 10)
        return image

    def action_masks(self) -> NDArray[np.int8]:
        """Return what is allowed."""
        return self.mask

    def step(self, action: Any) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        if not self.mask[action]:
            raise RuntimeError(f"the action {action} is forbidden by {self.mask}")
        return super().step(action % 2)


class FineShades(Shades):
    """The same of numbers from 0 to 1."""

    def __init__(self) -> None:
        super().__init__(as_bytes=False)


class Precise(gym.Env[NDArray[Any], Any]):
    """A random walk of any precision, ten steps an episode, that takes the actions of its space alone.

    Args:
        dtype: Name of the observations' type.
        shape: Of the observations.
        bounds: (low, high) of each component of continuous actions, None: no bound; None: two discrete actions.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        *,
        dtype: str = "float64",
        shape: Sequence[int] = (3,),
        bounds: Sequence[Sequence[float | None]] | None = None,
    ) -> None:
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, tuple(shape), np.dtype(dtype).type)
        self.action_space = gym.spaces.Discrete(2)
        if bounds is not None:
            low, high = (
                np.array([sign * np.inf if value is None else value for value in values], np.float32)
                for sign, values in zip((-1, 1), zip(*bounds, strict=True), strict=True)
            )
            self.action_space = gym.spaces.Box(low, high)
        self.ticks = 0

    def _observation(self) -> NDArray[Any]:
        return self.np_random.normal(size=self.observation_space.shape).astype(self.observation_space.dtype)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        super().reset(seed=seed)
        self.ticks = 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        self.ticks += 1
        return self._observation(), float(np.sum(action)), self.ticks >= 10, False, {}


SECRETS: dict[str, gym.Space[Any]] = {
    "discrete": gym.spaces.Discrete(4, start=2),
    "multi-discrete": gym.spaces.MultiDiscrete([2, 2], start=[1, 0]),
    "multi-binary": gym.spaces.MultiBinary(2),
    "matrix of whole numbers": gym.spaces.Box(0, 1, (1, 2), np.int64),
    "infinite bounds": gym.spaces.Box(-np.inf, np.inf, (2, 2), np.float64),
    "tuple": gym.spaces.Tuple((gym.spaces.Discrete(2), gym.spaces.MultiBinary(1))),
    "nested dict": gym.spaces.Dict(
        {
            "second": gym.spaces.Tuple((gym.spaces.Discrete(2), gym.spaces.Box(-1.0, 1.0, (2, 1), np.float32))),
            "first": gym.spaces.Dict({"bit": gym.spaces.MultiBinary(1), "choices": gym.spaces.MultiDiscrete([3, 2])}),
        }
    ),
}


class Secret(gym.Env[Any, np.int64]):
    """The observation tells which of four actions is the right one, in a space of each kind.

    16 steps; the reward is 1 for the right action. Always the same action gets 4 of 16, on average.

    Args:
        kind: A key of `SECRETS`.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, *, kind: str) -> None:
        self.kind = kind
        self.observation_space = SECRETS[kind]
        self.action_space = gym.spaces.Discrete(4)
        self.right, self.ticks = 0, 0

    def _observation(self) -> Any:
        self.right = int(self.np_random.integers(4))
        first, second = divmod(self.right, 2)
        noise = self.np_random.uniform(-1.0, 1.0, (2, 1)).astype(np.float32)
        return {
            "discrete": np.int64(2 + self.right),
            "multi-discrete": np.array([1 + first, second]),
            "multi-binary": np.array([first, second], np.int8),
            "matrix of whole numbers": np.array([[first, second]]),
            "infinite bounds": np.eye(4)[self.right].reshape(2, 2),
            "tuple": (first, np.array([second], np.int8)),
            "nested dict": {
                "first": {"bit": np.array([first], np.int8), "choices": np.array([self.ticks % 3, 1])},
                "second": (second, noise),
            },
        }[self.kind]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.ticks = 0
        return self._observation(), {}

    def step(self, action: np.int64) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.ticks += 1
        reward = float(action == self.right)
        return self._observation(), reward, self.ticks >= 16, False, {}


def register() -> None:
    """What the entry point names; more than once does no harm."""
    for env_id, entry_point, limit in (
        ("TestTicks-v0", Ticks, 7),
        ("TestTrouble-v0", Trouble, None),
        ("TestLaps-v0", Laps, None),
        ("TestShades-v0", Shades, None),
        ("TestFineShades-v0", FineShades, None),
        ("TestMaskedShades-v0", MaskedShades, None),
        ("TestBits-v0", Bits, None),
        ("TestBeside-v0", Beside, None),
        ("TestFineBeside-v0", FineBeside, None),
        ("TestMaskedBeside-v0", MaskedBeside, None),
        ("TestPair-v0", Pair, None),
        ("TestPrecise-v0", Precise, None),
        ("TestSecret-v0", Secret, None),
        ("TestReply-v0", Reply, None),
        ("TestForbidding-v0", Forbidding, None),
        ("TestForbiddingTwo-v0", ForbiddingTwo, None),
    ):
        if env_id not in gym.registry:
            # Gymnasium's type asks for classes that take any keywords.
            gym.register(env_id, entry_point, max_episode_steps=limit)  # type: ignore[arg-type]

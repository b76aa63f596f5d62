"""Environments that hang, end their process or return nonsense; child processes find them as `hostile_envs:Name`."""

from __future__ import annotations

import ctypes
import itertools
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import gymnasium as gym
import numpy as np


def hang() -> None:
    while True:
        time.sleep(0.1)


def hang_without_python() -> None:
    # By PyDLL it keeps the interpreter's lock: no thread of Python runs any more.
    ctypes.PyDLL(None).pause()


def segfault() -> None:
    ctypes.string_at(0)


def leave() -> None:
    raise SystemExit(5)


def fail() -> None:
    raise ValueError("the motor broke")


def assume() -> None:
    assert time.time() < 0


class MuteError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no words")


class Unshowable:
    def __repr__(self) -> str:
        raise RuntimeError("no words")


def say(error: Exception) -> NoReturn:
    raise error


WAYS: dict[str, Callable[[], object]] = {
    "say_no_text": lambda: say(ValueError("\udcff")),
    "say_much": lambda: say(ValueError("x" * 3_000_000)),
    "say_nothing": lambda: say(MuteError()),
    "hang": hang,
    "hang_without_python": hang_without_python,
    "exit": lambda: os._exit(7),
    "segfault": segfault,
    "leave": leave,
    "assume": assume,
    "fail": fail,
}


class Hostile(gym.Env[Any, Any]):
    """Steps along a line; at the given call of the given method it does what its `how` says.

    Args:
        how: One of `WAYS`.
        where: constructor, reset, step, render or close.
        at: Which call of it, in this object, from 1.
        num_steps: Length of an episode.
        step_s: Seconds that a step takes.
        only_after: Hostile only where this file exists.
        pids: A file to which each object writes its process's id, when it is first reset.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(
        self,
        *,
        how: str | None = None,
        where: str = "step",
        at: int = 1,
        num_steps: int = 20,
        step_s: float = 0.0,
        only_after: str | None = None,
        pids: str | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.how, self.where, self.at, self.num_steps = how, where, at, num_steps
        self.step_s, self.only_after, self.pids = step_s, only_after, pids
        self.render_mode = render_mode
        self.calls: dict[str, int] = {}
        self.steps = 0
        self._arrive("constructor")

    def _arrive(self, where: str) -> None:
        self.calls[where] = self.calls.get(where, 0) + 1
        is_time = where == self.where and self.calls[where] == self.at
        if self.how is not None and is_time and (self.only_after is None or Path(self.only_after).exists()):
            WAYS[self.how]()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._arrive("reset")
        if self.pids is not None and self.calls["reset"] == 1:
            with Path(self.pids).open("a") as file:
                file.write(f"{os.getpid()} {os.getppid()}\n")
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> Any:
        self._arrive("step")
        time.sleep(self.step_s)
        self.steps += 1
        return np.full(2, self.steps, np.float32), 1.0, self.steps >= self.num_steps, False, {}

    def render(self) -> Any:
        self._arrive("render")
        return np.zeros((64, 64, 3), np.uint8)

    def close(self) -> None:
        self._arrive("close")


class Malformed(gym.Env[Any, Any]):
    """Returns what its arguments say.

    Args:
        reset: Name of a fault of reset() in `RESETS`; None: it has none.
        step: Name of a fault of step() in `STEPS`.
    """

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)
    GOOD = np.zeros(2, np.float32)
    RESETS: ClassVar[dict[str, Any]] = {
        "alone": GOOD,
        "no info": (GOOD, None),
        "shape": (np.zeros(3, np.float32), {}),
        "none": (None, {}),
        "text": (np.array(["a", "b"]), {}),
        "nan": (np.array([0.0, np.nan], np.float32), {}),
        "nothing": None,
    }
    STEPS: ClassVar[dict[str, Any]] = {
        "four values": (GOOD, 1.0, False, {}),
        "no reward": (GOOD, None, False, False, {}),
        "text reward": (GOOD, "1.0", False, False, {}),
        "nan reward": (GOOD, float("nan"), False, False, {}),
        "huge reward": (GOOD, 1e300, False, False, {}),
        "huge observation": (np.array([0.0, 1e39]), 1.0, False, False, {}),
        "two rewards": (GOOD, np.zeros(2), False, False, {}),
        "rewards of agents": (GOOD, [1, 0.5], False, False, {}),
        "rewards by name": (GOOD, {0: 1.0, 1: 0.5}, False, False, {}),
        "square of rewards": (GOOD, np.zeros((2, 2)), False, False, {}),
        "empty reward": (GOOD, [], False, False, {}),
        "uneven rewards": (GOOD, [1, [0.5, 2]], False, False, {}),
        "texts as rewards": (GOOD, ["1.0", "2.0"], False, False, {}),
        "number terminated": (GOOD, 1.0, 0, False, {}),
        "no truncated": (GOOD, 1.0, False, None, {}),
        "unshowable truncated": (GOOD, 1.0, False, Unshowable(), {}),
        "long text as reward": (GOOD, "x" * 1_000_000, False, False, {}),
        "shape": (np.zeros((2, 1), np.float32), 1.0, False, False, {}),
        "complex": (np.zeros(2, np.complex64), 1.0, False, False, {}),
        "infinite": (np.array([np.inf, 0.0], np.float32), 1.0, False, False, {}),
        "no info": (GOOD, 1.0, False, False, [1, 2]),
        "nothing": None,
        # Harmless.
        "float64": (np.zeros(2), 1.0, False, False, {}),
        "list": ([0, 0], 1, np.bool_(0), np.array(False), {}),
        "reward in an array": (GOOD, np.ones(1), False, False, {}),
        "reward in a list": (GOOD, [1.0], False, False, {}),
    }

    INFOS: ClassVar[Iterator[dict[str, Any]]] = itertools.cycle(
        [{"x": 1}, {"x": "text"}, {"x": 10**30}, {"x": np.zeros(2)}, {"x": np.zeros(3)}, {"x": {}}]
    )

    def __init__(self, *, reset: str | None = None, step: str | None = None) -> None:
        self.reset_fault, self.step_fault = reset, step

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return (self.GOOD, {}) if self.reset_fault is None else self.RESETS[self.reset_fault]

    def step(self, action: Any) -> Any:
        if self.step_fault == "infos":
            return self.GOOD, 1.0, False, False, next(self.INFOS)
        return (self.GOOD, 1.0, False, False, {}) if self.step_fault is None else self.STEPS[self.step_fault]

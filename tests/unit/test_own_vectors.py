"""A vectorised version of the env's own is used if it resets as a loop does, by what it says once it is made, too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from policies.envs.checked import CheckedEnvs
from policies.envs.make import make_vector_env

ENV = "TestCorridor-v0"


class Corridor(gym.Env[Any, Any]):
    """Three steps, which give 1, 10 and 100."""

    observation_space = gym.spaces.Box(0, 10, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self._seen(), float(10 ** (self.steps - 1)), self.steps == 3, False, {}

    def _seen(self) -> Any:
        return np.array([self.steps], np.float32)


def by_function(mode: AutoresetMode) -> Callable[..., Any]:
    def many(num_envs: int) -> Any:
        return SyncVectorEnv([Corridor] * num_envs, autoreset_mode=mode)

    return many


def by_class(mode: AutoresetMode) -> Callable[..., Any]:
    class Many(SyncVectorEnv):
        def __init__(self, num_envs: int) -> None:
            super().__init__([Corridor] * num_envs, autoreset_mode=mode)

    return Many


def by_text(mode: AutoresetMode) -> Callable[..., Any]:
    def many(num_envs: int) -> Any:
        env = SyncVectorEnv([Corridor] * num_envs, autoreset_mode=mode)
        env.metadata = {"autoreset_mode": mode.value}
        return env

    return many


@pytest.mark.parametrize("made", [by_function, by_class, by_text])
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_the_mode_that_a_vectorised_version_has_once_it_is_made_counts(
    mode: AutoresetMode, made: Callable[[AutoresetMode], Callable[..., Any]]
) -> None:
    vectorised = made(mode)
    gym.register(ENV, cast("Any", Corridor), vector_entry_point=cast("Any", vectorised))
    try:
        envs = make_vector_env(ENV, None, 2)
        # The loop that is made instead gives each env a wrapper of its own, the version here gives none.
        is_own = all(env is env.unwrapped for env in cast("Any", envs.unwrapped).envs)
        assert is_own == (mode is AutoresetMode.NEXT_STEP)
        assert _episodes_of_the_first(CheckedEnvs(envs, ENV)) == [(111.0, 3, 3.0)] * 3
    finally:
        del gym.registry[ENV]


def _episodes_of_the_first(envs: CheckedEnvs) -> list[tuple[float, int, float]]:
    """Return, of its episodes in 12 steps, as an env runner counts: returns, lengths and last observations."""
    envs.reset(seed=0)
    episodes, total, length, resets = [], 0.0, 0, False
    for _ in range(12):
        seen, rewards, terminated, _, _ = envs.step(np.zeros(2, np.int64))
        if resets:  # the step after an episode's last resets, and is none of the next one's
            resets = False
            continue
        total, length = total + float(rewards[0]), length + 1
        if terminated[0]:
            episodes.append((total, length, float(seen[0, 0])))
            total, length, resets = 0.0, 0, True
    return episodes

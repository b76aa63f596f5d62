"""A time limit of the environment's arguments also goes to a constructor that has an argument of that name."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from policy_factory import registered

from policies.envs.make import check_env, make_env, make_vector_env
from policies.envs.wrappers import wrapper_of
from policies.errors import EnvError

ENV = "TestLimited-v0"


class Limited(gym.Env[Any, Any]):
    """Cuts off its episodes itself."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, max_episode_steps: int = 3) -> None:
        self.limit, self.steps = max_episode_steps, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return np.zeros(2, np.float32), 1.0, False, self.steps == self.limit, {}


class Required(Limited):
    """Cannot be made without a limit."""

    def __init__(self, max_episode_steps: int, size: int = 1) -> None:
        super().__init__(max_episode_steps)
        self.size = size


class AnyName(Limited):
    """Takes arguments of any name, and hands on what it is given."""

    def __init__(self, **given: Any) -> None:
        super().__init__(4)
        self.given = given


def length(env: Any) -> int:
    env.reset(seed=0)
    for steps in range(1, 20):
        *_, truncated, _ = env.step(env.action_space.sample())
        if np.any(truncated):
            return steps
    raise AssertionError("it does not end")


@pytest.mark.parametrize("kind", [Limited, Required])
def test_it_is_given_to_one_env_and_to_those_of_a_vector(kind: type[Limited]) -> None:
    args = {"max_episode_steps": 7}
    with registered(ENV, kind):
        assert check_env(ENV, args).max_episode_steps == 7
        env: Any = make_env(ENV, args)
        assert env.unwrapped.limit == 7
        assert wrapper_of(env, TimeLimit) is not None
        vector: Any = make_vector_env(ENV, args, 2)
        assert [one.unwrapped.limit for one in vector.unwrapped.envs] == [7, 7]
        assert length(env) == length(vector) == 7


def test_it_goes_before_what_the_env_is_registered_with() -> None:
    args = {"max_episode_steps": 7}
    with registered(ENV, Required):
        gym.registry[ENV].kwargs = {"max_episode_steps": 5, "size": 2}
        env: Any = make_env(ENV, args)
        vector: Any = make_vector_env(ENV, args, 1)
        for inner in (env.unwrapped, vector.unwrapped.envs[0].unwrapped):
            assert (inner.limit, inner.size) == (7, 2)
        assert gym.registry[ENV].kwargs == {"max_episode_steps": 5, "size": 2}


def test_without_it_the_constructor_has_its_own() -> None:
    with registered(ENV, Limited):
        env: Any = make_env(ENV)
        assert (env.unwrapped.limit, length(env)) == (3, 3)
        assert wrapper_of(env, TimeLimit) is None
    with registered(ENV, Required), pytest.raises(EnvError, match="missing 1 required positional argument"):
        make_env(ENV)


def test_a_constructor_of_any_arguments_is_not_given_it() -> None:
    with registered(ENV, AnyName):
        env: Any = make_env(ENV, {"max_episode_steps": 2, "size": 3})
        assert env.unwrapped.given == {"size": 3}
        assert length(env) == 2

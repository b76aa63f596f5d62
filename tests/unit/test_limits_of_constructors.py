"""A time limit of the environment's arguments also goes to a constructor that has an argument of that name."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import HumanRendering, TimeLimit
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


class HandsOn(Limited):
    """Hands on what it is given, as to the class that it is derived from."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)


class Drawn(Limited):
    """Opens no window itself."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012

    def __init__(self, max_episode_steps: int = 3, render_mode: str | None = None) -> None:
        super().__init__(max_episode_steps)
        self.render_mode = render_mode


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


@pytest.mark.parametrize("kind", [Limited, Required, HandsOn])
def test_one_that_it_is_registered_with_reaches_those_of_a_vector_too(kind: type[Limited]) -> None:
    with registered(ENV, kind):
        gym.registry[ENV].kwargs = {"max_episode_steps": 5}
        env: Any = make_env(ENV)
        vector: Any = make_vector_env(ENV, {}, 2)
        assert [one.unwrapped.limit for one in (env, *vector.unwrapped.envs)] == [5, 5, 5]
        assert length(env) == length(vector) == 5
        # As gym.make does, it is the constructor's alone.
        assert [wrapper_of(one, TimeLimit) for one in (env, *vector.unwrapped.envs)] == [None] * 3
        assert check_env(ENV, {}).max_episode_steps is None
        assert gym.registry[ENV].kwargs == {"max_episode_steps": 5}


def test_one_that_it_is_registered_with_stays_where_the_arguments_have_another() -> None:
    with registered(ENV, HandsOn):
        gym.registry[ENV].kwargs = {"max_episode_steps": 5}
        env: Any = make_env(ENV, {"max_episode_steps": 4})
        vector: Any = make_vector_env(ENV, {"max_episode_steps": 4}, 2)
        assert [one.unwrapped.limit for one in (env, *vector.unwrapped.envs)] == [5, 5, 5]
        assert length(env) == length(vector) == 4


def test_a_window_is_opened_around_what_has_none() -> None:
    for given, args in (({"max_episode_steps": 5}, {}), ({}, {"max_episode_steps": 5})):
        with registered(ENV, Drawn):
            gym.registry[ENV].kwargs = given
            env: Any = make_env(ENV, args, render_mode="human")
            assert wrapper_of(env, HumanRendering) is not None
            assert (env.unwrapped.render_mode, env.unwrapped.limit) == ("rgb_array", 5)


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

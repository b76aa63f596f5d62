"""Copies of an environment that are stepped in a loop share nothing that one of them writes into."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest

from policies.envs.make import make_env, make_vector_env
from policies.errors import EnvError

ENV = "TestWeights-v0"


class Weights(gym.Env[Any, Any]):
    """Observes a mass that it draws into the dict that it was given, as domain randomisation does."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012 (Gymnasium's)
    observation_space = gym.spaces.Box(0, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(
        self, physics: dict[str, Any], render_mode: str | None = None, max_episode_steps: int | None = None
    ) -> None:
        self.physics, self.limit, self.render_mode = physics, max_episode_steps, render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.physics["mass"] = [self.np_random.random()]
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self._seen(), 1.0, False, False, {}

    def render(self) -> Any:
        return np.full((20, 30, 3), 7, np.uint8)

    def _seen(self) -> Any:
        return np.array(self.physics["mass"], np.float32)


class Around(gym.Wrapper[Any, Any, Any, Any]):
    """An environment of one's own that is a wrapper."""

    def __init__(self, physics: dict[str, Any], render_mode: str | None = None) -> None:
        super().__init__(Weights(physics, render_mode))


def made_by_function(physics: dict[str, Any]) -> gym.Env[Any, Any]:
    return Weights(physics)


@pytest.fixture(autouse=True)
def _forget() -> Iterator[None]:
    yield
    gym.registry.pop(ENV, None)


@pytest.mark.parametrize("creator", [Weights, Around, f"{__name__}:Weights", made_by_function])
@pytest.mark.parametrize("is_registered", [False, True])
@pytest.mark.parametrize("more", [{}, {"max_episode_steps": 5}], ids=str)
def test_each_copy_has_arguments_of_its_own(creator: Any, is_registered: bool, more: dict[str, Any]) -> None:
    args = {"physics": {"mass": [0.0], "gravity": 9.8}}
    gym.register(ENV, cast("Any", creator), kwargs=args if is_registered else {})
    given = more if is_registered else {**args, **more}
    envs = make_vector_env(ENV, given, 3)
    envs.reset(seed=4)
    seen = envs.step(np.zeros(3, np.int64))[0]
    alone = [make_env(ENV, given).reset(seed=4 + number)[0] for number in range(3)]
    np.testing.assert_array_equal(seen, alone)
    assert args == {"physics": {"mass": [0.0], "gravity": 9.8}}


class Kept(Weights):
    """Has whatever it is given, as large tables of data or what can't be copied."""

    def __init__(self, **given: Any) -> None:
        super().__init__({})
        self.given = given


class Odd(dict[str, Any]):
    """A dict of somebody's own."""


def test_what_is_neither_list_nor_dict_nor_set_is_shared() -> None:
    table = np.zeros(10)
    given = {"data": {"tables": [table]}, "pair": ({"a": [1]}, table), "names": {"a"}, "odd": Odd(a=[table])}
    gym.register(ENV, cast("Any", Kept))
    one, two = (env.unwrapped.given for env in cast("Any", make_vector_env(ENV, given, 2).unwrapped).envs)
    for owned, others in (
        (one["data"], two["data"]), (one["data"]["tables"], two["data"]["tables"]), (one["names"], two["names"]),
        (one["pair"][0]["a"], two["pair"][0]["a"]), (one["odd"], two["odd"]), (one["odd"]["a"], two["odd"]["a"]),
    ):  # fmt: skip
        assert type(owned) is type(others)
        assert str(owned) == str(others)
        assert owned is not others
    assert one["data"]["tables"][0] is two["data"]["tables"][0]
    assert one["pair"][1] is two["pair"][1]
    assert one["odd"]["a"][0] is two["odd"]["a"][0]


def test_what_an_env_is_registered_with_is_shared_by_its_copies() -> None:
    gym.register(ENV, cast("Any", Kept), kwargs={"table": np.zeros(10)})
    envs = cast("Any", make_vector_env(ENV, None, 3).unwrapped).envs
    assert len({id(env.unwrapped.given["table"]) for env in envs}) == 1


def test_copies_are_drawn_as_one_is() -> None:
    gym.register(ENV, cast("Any", Weights))
    given = {"physics": {}, "pixels": True}
    envs = make_vector_env(ENV, given, 2)
    np.testing.assert_array_equal(envs.reset(seed=0)[0], [make_env(ENV, given).reset(seed=0)[0]] * 2)


class Drawn(Weights):
    """Is always drawn."""

    def __init__(self, render_mode: str | None) -> None:
        super().__init__({}, {"human": "human", "rgb_array": "rgb_array"}[render_mode or ""])


def test_gymnasium_still_knows_how_they_can_be_drawn() -> None:
    gym.register(ENV, cast("Any", Drawn), kwargs={"render_mode": "human"})
    for env in cast("Any", make_vector_env(ENV, None, 2).unwrapped).envs:
        assert env.unwrapped.render_mode == "rgb_array"


def test_one_that_is_registered_without_what_makes_it_is_refused() -> None:
    gym.register(ENV, vector_entry_point=cast("Any", lambda num_envs, other: None))
    with pytest.raises(EnvError, match="cannot be made"):
        make_vector_env(ENV, None, 2)

"""The time limit that acts is the least of all around an environment, also of those that its own wrappers hide."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import pytest
from policy_factory import registered

from policies.envs.make import check_env, make_env
from policies.errors import EnvError

ENV = "TestCar-v0"


class Around(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper around MountainCar, of which Gymnasium cuts off episodes after 200 env steps."""

    def __init__(self) -> None:
        super().__init__(gym.make("MountainCar-v0"))


class Unlimited(gym.Wrapper[Any, Any, Any, Any]):
    """The same around one without a limit."""

    def __init__(self) -> None:
        super().__init__(gym.make("MountainCar-v0", max_episode_steps=-1))


def played(args: dict[str, Any] | None) -> int:
    env = make_env(ENV, args)
    env.reset(seed=0)
    for steps in range(1, 400):
        if env.step(1)[3]:
            return steps
    return 400


@pytest.mark.parametrize(
    ("kind", "asked", "limit"),
    [(Around, None, 200), (Around, 100, 100), (Around, 200, 200), (Unlimited, None, None), (Unlimited, 300, 300)],
)
def test_the_limit_is_that_which_acts(kind: type[gym.Env[Any, Any]], asked: int | None, limit: int | None) -> None:
    args = None if asked is None else {"max_episode_steps": asked}
    with registered(ENV, kind):
        assert check_env(ENV, args).max_episode_steps == limit
        assert played(args) == (limit or 400)


def test_a_limit_that_never_acts_is_refused() -> None:
    with registered(ENV, Around):
        with pytest.raises(EnvError, match=r"'max_episode_steps' of TestCar-v0 is 1,000, .* 200 env steps") as caught:
            check_env(ENV, {"max_episode_steps": 1000})
        assert "max_episode_steps=-1" in str(caught.value.hint)

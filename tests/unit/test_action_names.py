"""What actions are called: as the environment says, as is known of Gymnasium's own, or not at all."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from policies.envs.action_names import action_names
from policies.envs.make import make_env


class Named(gym.Env[Any, Any]):
    """Says what its actions are called, or fails to."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, said: Any, num_actions: int = 2) -> None:
        self.said, self.action_space = said, gym.spaces.Discrete(num_actions, start=3)

    def get_action_meanings(self) -> Any:
        if isinstance(self.said, Exception):
            raise self.said
        return self.said


@pytest.mark.parametrize(("env_id", "names"), [
    ("CartPole-v1", ("push left", "push right")),
    ("CartPole-v0", ("push left", "push right")),
    ("MountainCar-v0", ("push left", "don't push", "push right")),
    ("Acrobot-v1", ("torque -1", "no torque", "torque +1")),
    ("Pendulum-v1", None),
])  # fmt: skip
def test_known_ones_have_names(env_id: str, names: tuple[str, ...] | None) -> None:
    assert action_names(make_env(env_id)) == names


def test_an_environment_says_its_own() -> None:
    assert action_names(Named(["NOOP", "FIRE"])) == ("NOOP", "FIRE")
    assert action_names(Named(["x" * 1000, "y"])) == ("x" * 40, "y")


@pytest.mark.parametrize("said", [["NOOP"], ["NOOP", 3], None, "ab", RuntimeError("no rom")])
def test_what_are_no_names_for_all_actions_is_left(said: Any) -> None:
    assert action_names(Named(said)) is None

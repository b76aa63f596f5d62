"""What an env runner sends to its environment is not what its learner learns from."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from policies.envs.action_bounds import ToBounds

pytestmark = pytest.mark.ray


@pytest.mark.parametrize(
    ("space", "drawn", "sent"),
    [
        (gym.spaces.Discrete(3), [2, 0], [2, 0]),
        (gym.spaces.Discrete(3, start=5), [2, 0], [7, 5]),
        (gym.spaces.MultiDiscrete([3, 3]), [[2, 0], [1, 1]], [[2, 0], [1, 1]]),
        (gym.spaces.Box(-4, 4, (1,), np.float32), [[0.5], [-1.0]], [[2.0], [-4.0]]),
        (gym.spaces.Box(-np.inf, np.inf, (1,), np.float32), [[0.5], [-1.0]], [[0.5], [-1.0]]),
    ],
)
def test_an_env_that_writes_into_its_actions_leaves_those_that_are_learned_from(
    space: gym.Space[Any], drawn: Any, sent: Any
) -> None:
    from policies.rllib.env_runner import ArrayEnvRunner

    runner: Any = object.__new__(ArrayEnvRunner)
    runner.env = SimpleNamespace(single_action_space=space)
    runner._to_bounds = ToBounds(space) if isinstance(space, gym.spaces.Box) else None
    actions = np.array(drawn, space.dtype)
    to_env = runner._for_env(actions)
    assert to_env.tolist() == sent
    to_env[:] = 0
    assert actions.tolist() == drawn

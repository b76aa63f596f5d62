"""Members of a pack take no action that a mask forbids, whatever their weights have become."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
import numpy as np
import pytest

from policies.envs.masks import FORBIDDEN
from policies.hyperparams import make_hyperparams
from policies.packed.envs.make import make_packed_envs
from policies.packed.initial import new_member
from policies.packed.make import make_stack
from policies.packed.sampling import mask_outputs

if TYPE_CHECKING:
    from policies.hyperparams import TrainedHyperparams

NUM_INPUTS = 4


def test_a_mask_leaves_what_it_allows_to_the_bit() -> None:
    rng = np.random.default_rng(0)
    outputs = (10.0 ** rng.uniform(-30, 30, (500, 3)) * rng.choice([-1, 1], (500, 3))).astype(np.float32)
    allowed = rng.random((500, 3)) < 0.5
    found = outputs.copy()
    mask_outputs(found, np.concatenate([allowed, rng.random((500, 2))], axis=1), 3)
    np.testing.assert_array_equal(found, np.where(allowed, outputs, np.float32(FORBIDDEN)))


class Bandit(gym.Env[Any, Any]):
    """One arm is allowed at a time; it counts pulls of the other."""

    observation_space: gym.Space[Any] = gym.spaces.Box(-1, 1, (NUM_INPUTS,), np.float32)

    def __init__(self, pulls: list[int], num_actions: int) -> None:
        self.pulls, self.action_space, self.only = pulls, gym.spaces.Discrete(num_actions), 0

    def action_masks(self) -> list[bool]:
        return [place == self.only for place in range(int(cast("Any", self.action_space).n))]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(NUM_INPUTS, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.pulls.append(int(action != self.only))
        self.only = int(self.np_random.integers(cast("Any", self.action_space).n))
        return np.zeros(NUM_INPUTS, np.float32), 0.0, False, False, {}


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("ruined", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(("algorithm", "num_actions"), [("ppo", 2), ("ppo", 3), ("dqn", 2)])
def test_a_member_whose_weights_are_ruined_takes_no_forbidden_action(
    algorithm: Any, num_actions: int, ruined: float
) -> None:
    pulls: list[int] = []
    gym.register("TestBandit-v0", cast("Any", lambda: Bandit(pulls, num_actions)))
    try:
        envs = make_packed_envs("TestBandit-v0", {}, 2, kind="scalar")
        changes = {"train_batch_size": 64, "minibatch_size": 64} if algorithm == "ppo" else {"learning_starts": 10_000}
        hyperparams = cast("TrainedHyperparams", make_hyperparams(algorithm, {"num_envs": 2, **changes}))
        stack = make_stack(hyperparams, envs)
        member = new_member("a", hyperparams, 1, envs.observation_space, envs.action_space)
        for name, weight in member.weights.items():
            if name.endswith("bias") and "vf" not in name:
                weight[:] = ruined
        stack.add(member, 7)
        stack.train_iteration()
    finally:
        del gym.registry["TestBandit-v0"]
    assert len(pulls) >= 64
    assert sum(pulls) == 0
    assert envs.errors == {}

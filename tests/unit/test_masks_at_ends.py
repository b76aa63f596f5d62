"""Masks of actions at the ends of episodes, and at the beginnings of the next ones."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from policy_factory import registered

from policies.acting.evaluate import evaluate_policy
from policies.acting.policy import RandomPolicy
from policies.envs.make import make_env, make_vector_env
from policies.packed.envs.sub_envs import SubEnvs

pytestmark = pytest.mark.usefixtures("env_plugin")

ENV = "TestForbidding-v0"


def first_allowed(rows: Any) -> Any:
    return 7 + np.asarray(rows)[..., :4].argmax(axis=-1)


def test_after_a_truncated_step_the_mask_is_the_envs_own_and_has_to_be_one() -> None:
    # DQN asks for the best action there.
    env = make_env(ENV, {"max_episode_steps": 2})
    own: Any = env.unwrapped
    observation, _ = env.reset(seed=1)
    env.step(first_allowed(observation))
    observation, _, terminated, truncated, _ = env.step(first_allowed(own.mask))
    assert (terminated, truncated) == (False, True)
    assert observation[:4].tolist() == own.mask.tolist() != [1, 1, 1, 1]
    env = make_env(ENV, {"max_episode_steps": 2, "goes_wrong": "nothing"})
    observation, _ = env.reset(seed=1)
    observation, *_ = env.step(first_allowed(observation))
    with pytest.raises(ValueError, match="after env step 2 of an episode, which forbids every action"):
        env.step(first_allowed(observation))


def test_the_next_episode_of_a_vector_begins_with_its_own_mask_and_frames() -> None:
    plain, stacked = make_vector_env(ENV, {}, 2), make_vector_env(ENV, {"frame_stack": 3}, 2)
    rows, _ = plain.reset(seed=1)
    stacked.reset(seed=1)
    for _ in range(17):
        # The seventeenth only resets.
        actions = first_allowed(rows)
        rows, stacks = plain.step(actions)[0], stacked.step(actions)[0]
    inner: Any = plain.unwrapped
    assert rows[:, :4].tolist() == [game.unwrapped.mask.tolist() for game in inner.envs]
    assert not rows[:, :4].all()
    assert np.array_equal(stacks, np.concatenate([rows[:, :4], *[rows[:, 4:]] * 3], axis=1))


class Over(gym.Env[Any, Any]):
    """A game of three moves, which has none to ask for when it is over, or after a move too early."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, moves: int = 3) -> None:
        self.moves, self.steps = moves, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert action == 1
        self.steps += 1
        return np.zeros(2, np.float32), 1.0, self.steps == 3, False, {}

    def action_masks(self) -> Any:
        if self.steps >= self.moves:
            raise RuntimeError("the game is over")
        return [False, True]


def test_a_game_that_is_over_need_have_no_method_to_ask() -> None:
    with registered("TestOver-v0", Over):
        packed = SubEnvs("TestOver-v0", {})
        packed.add("m", [0])
        ends = [packed.step(np.ones(1, np.int64)) for _ in range(4)]
        assert [bool(step.terminated[0]) for step in ends] == [False, False, True, False]
        assert [step.errors for step in ends] == [{}] * 4
        assert [step.final_observations[0, :2].tolist() for step in ends] == [[0, 1], [0, 1], [1, 1], [0, 1]]
        assert ends[2].first_observations[0][:2].tolist() == [0, 1]
        rows = make_vector_env("TestOver-v0", {}, 2)
        rows.reset(seed=0)
        # The fourth only resets.
        masks = [rows.step(np.ones(2, np.int64))[0][:, :2].tolist() for _ in range(4)]
        assert masks == [[[0, 1]] * 2] * 2 + [[[1, 1]] * 2, [[0, 1]] * 2]
        policy = RandomPolicy.for_env("TestOver-v0")
        assert evaluate_policy(policy, env_id="TestOver-v0", seeds=[0, 1]).returns == (3.0, 3.0)


def test_one_that_goes_on_has_to_have_it_also_where_it_is_cut_off() -> None:
    with registered("TestOver-v0", Over):
        env = make_env("TestOver-v0", {"moves": 2, "max_episode_steps": 2})
        env.reset(seed=0)
        env.step(1)
        with pytest.raises(RuntimeError, match="the game is over"):
            env.step(1)

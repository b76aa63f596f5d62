"""Masks of actions at the ends of episodes, and at the beginnings of the next ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from policies.envs.make import make_env, make_vector_env

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

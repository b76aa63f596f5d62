"""Compare environments that are stepped together with those that step themselves."""

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

from policies.acting.evaluate import Evaluator, play_episode
from policies.acting.policy import NetworkPolicy
from policies.envs.make import make_env
from policies.packed.envs.sub_envs import SubStep
from policies.portable.file import Layer, PolicyNetwork, PortablePolicy, describe_space


def assert_equal_steps(ours: SubStep, theirs: SubStep) -> None:
    """Assert that two steps gave the same, to the last bit and the type."""
    for name in ("final_observations", "rewards", "terminated", "truncated"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name, strict=True)
    assert list(ours.first_observations) == list(theirs.first_observations)
    for place, first in theirs.first_observations.items():
        np.testing.assert_array_equal(ours.first_observations[place], first, strict=True)
    assert ours.errors.keys() == theirs.errors.keys()


def policy_of(env_id: str, seed: int) -> NetworkPolicy:
    """Return a policy of random weights for an environment with vectors, and powers or choices as actions."""
    env = make_env(env_id)
    space, actions = env.observation_space, env.action_space
    assert isinstance(space, gym.spaces.Box)
    if is_continuous := isinstance(actions, gym.spaces.Box):
        num = 2 * actions.shape[0]
    else:
        assert isinstance(actions, gym.spaces.Discrete)
        num = int(actions.n)
    rng = np.random.default_rng(seed)

    def weights(*shape: int) -> NDArray[np.float32]:
        return rng.normal(0, 0.5, shape).astype(np.float32)

    layers = (
        Layer(weights(16, space.shape[0]), weights(16), "tanh"),
        Layer(weights(num, 16), weights(num), "linear"),
    )
    return NetworkPolicy(
        PortablePolicy(
            network=PolicyNetwork("gaussian" if is_continuous else "categorical", layers),
            algorithm="ppo",
            env_id=env_id,
            env_args={},
            observation_space=describe_space(space),
            action_space=describe_space(actions),
            action_transform="unsquash" if is_continuous else "none",
            training={},
        )
    )


def check_episodes(env_id: str, monkeypatch: pytest.MonkeyPatch, *, cap: int, limit: int) -> tuple[int, ...]:
    """Assert that an evaluation, which steps no environment by itself, plays the episodes that are played alone.

    Args:
        env_id: Gymnasium id.
        monkeypatch: For the environments' own steps.
        cap: On the steps of an episode, under the limit.
        limit: The environment's time limit.

    Returns:
        The lengths of the episodes under the cap.
    """
    args, seeds = {"max_episode_steps": limit}, list(range(20))
    policy = policy_of(env_id, 3)
    alone = [play_episode(policy, make_env(env_id, args), seed, max_episode_steps=cap) for seed in seeds]
    for some_cap in (cap, limit + 50, None):
        with Evaluator(env_id, args, seeds, max_episode_steps=some_cap) as evaluator:
            for env in evaluator._envs:
                monkeypatch.setattr(env, "step", None)  # it is not called
            episodes = evaluator.run(policy)
            again = evaluator.run(policy)
        assert episodes == again
        if some_cap == cap:
            assert list(zip(episodes.returns, episodes.lengths, strict=True)) == alone
        else:
            assert max(episodes.lengths) <= limit
    return tuple(length for _, length in alone)

"""Turn a member of a pack into a portable policy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym

from policies.acting.policy import action_transform
from policies.hyperparams import PPOHyperparams
from policies.networks.portable_weights import network_from_weights
from policies.packed.member import AnyMember
from policies.portable.file import PortablePolicy, describe_space


def portable_policy(
    member: AnyMember,
    observation_space: gym.Space[Any],
    action_space: gym.Space[Any],
    *,
    env_id: str,
    env_args: Mapping[str, Any],
    training: Mapping[str, Any],
) -> PortablePolicy:
    """Return the greedy policy of a member whose weights were written back."""
    return PortablePolicy(
        network=network_from_weights(member.weights, member.hyperparams, observation_space, action_space),
        algorithm="ppo" if isinstance(member.hyperparams, PPOHyperparams) else "dqn",
        env_id=env_id,
        env_args=dict(env_args),
        observation_space=describe_space(observation_space),
        action_space=describe_space(action_space),
        action_transform=action_transform(action_space),
        training=dict(training),
    )

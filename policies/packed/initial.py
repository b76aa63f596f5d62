"""Make new members; their initial weights are those that RLlib would give them."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch

from policies import random_streams
from policies.envs.masks import seen_by_networks
from policies.hyperparams import PPOHyperparams
from policies.networks.parts import DQNNetworks, PPONetworks, model_config
from policies.packed.member import OBS_COUNT, OBS_MEAN, OBS_VAR, TARGET_PREFIX, H, Member, Weights


def new_member(
    member_id: str,
    hyperparams: H,
    seed: int,
    observation_space: gym.Space[Any],
    action_space: gym.Space[Any],
) -> Member[H]:
    """Return a member that has not trained yet.

    Its weights are, to the last bit, those of `RLModuleSpec.build()` after `torch.manual_seed(seed)`: the same parts
    build both, and RLlib itself, which takes a second to load, is not needed.

    Args:
        member_id: Its trial's id.
        hyperparams: Validated hyperparameters.
        seed: The trial's seed, for the weights and for all random numbers of the member.
        observation_space: The environment's.
        action_space: The environment's.
    """
    build = PPONetworks if isinstance(hyperparams, PPOHyperparams) else DQNNetworks
    torch.manual_seed(seed)
    networks = build(observation_space, action_space, model_config(hyperparams))
    weights: Weights = {name: np.array(value.detach().numpy()) for name, value in networks.state_dict().items()}
    if not isinstance(hyperparams, PPOHyperparams) and hyperparams.target_network:
        weights |= {f"{TARGET_PREFIX}{name}": np.array(value) for name, value in weights.items()}
    if hyperparams.normalize_observations:
        shape = seen_by_networks(observation_space).shape or ()
        weights[OBS_MEAN], weights[OBS_VAR] = np.zeros(shape, np.float32), np.ones(shape, np.float32)
        weights[OBS_COUNT] = np.array(0, dtype=np.int64)
    return Member(
        member_id,
        hyperparams,
        seed,
        weights,
        kl_coeff=hyperparams.kl_coeff if isinstance(hyperparams, PPOHyperparams) else 0.0,
        rng=random_streams.member_draws(seed),
    )

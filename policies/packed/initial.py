"""First weights of a member: those of the RLModule that RLlib builds for its hyperparameters."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch

from policies.hyperparams import PPOHyperparams, TrainedHyperparams
from policies.networks import module_spec
from policies.packed.member import Member


def new_member(
    member_id: str,
    hyperparams: TrainedHyperparams,
    seed: int,
    observation_space: gym.Space[Any],
    action_space: gym.Space[Any],
) -> Member:
    """A member that has not trained yet.

    Args:
        member_id: Its trial's id.
        hyperparams: Validated.
        seed: The trial's: of the weights and of all that the member draws.
        observation_space: The environment's.
        action_space: The environment's.
    """
    spec = module_spec(hyperparams)
    spec.observation_space, spec.action_space, spec.inference_only = observation_space, action_space, False
    torch.manual_seed(seed)
    module = spec.build()
    if hasattr(module, "make_target_networks"):
        module.make_target_networks()
    weights = {name: np.array(value.detach().numpy()) for name, value in module.state_dict().items()}
    return Member(
        member_id,
        hyperparams,
        seed,
        weights,
        kl_coeff=hyperparams.kl_coeff if isinstance(hyperparams, PPOHyperparams) else 0.0,
        rng=np.random.default_rng(np.random.SeedSequence([seed, 0])),
    )

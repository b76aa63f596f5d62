"""What the RLModules of PPO and DQN are made of: torch alone, so that packs build them without loading RLlib.

Random numbers are drawn in the order of these functions; `policies.networks.rl_modules` builds its modules with them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
from torch import nn

from policies.hyperparams import PPOHyperparams, TrainedHyperparams
from policies.networks.epsilon import EpsilonSchedule
from policies.networks.layers import Encoder, hidden_gain, initialize

# RLlib resolves an activation by these names (its models/utils.py): a torch.nn class name or one of its own.
RLLIB_ACTIVATIONS = {
    "linear": "linear", "relu": "relu", "tanh": "tanh", "silu": "silu", "elu": "elu", "gelu": "GELU",
}  # fmt: skip
_OUR_ACTIVATIONS = {theirs: ours for ours, theirs in RLLIB_ACTIVATIONS.items()}


class PPONetworks(nn.Module):
    """Encoders, policy head `pi` and value head `vf`.

    Args:
        observation_space: Of the environment.
        action_space: Of the environment.
        config: As `model_config` gives it.
        inference_only: Leave out the value function's own encoder.

    Raises:
        SpecError: Convolutions and observations do not go together.
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        config: Mapping[str, Any],
        *,
        inference_only: bool = False,
    ) -> None:
        super().__init__()
        names = ["encoder"] if config["vf_share_layers"] else ["actor_encoder", "critic_encoder"]
        names = names[:1] if inference_only else names
        encoders = {name: make_encoder(observation_space, config) for name in names}
        self.encoder = nn.ModuleDict(encoders)
        num_features = encoders[names[0]].num_features
        self.pi = nn.Linear(num_features, num_policy_outputs(action_space))
        self.vf = nn.Linear(num_features, 1)
        initialize_networks(config, hidden=[self.encoder], heads=[(self.pi, 0.01), (self.vf, 1.0)])


class DQNNetworks(nn.Module):
    """Encoder, head `af` of Q-values or advantages, and, if dueling, the value head `vf`.

    Args:
        observation_space: Of the environment.
        action_space: Of the environment.
        config: As `model_config` gives it.

    Raises:
        SpecError: Convolutions and observations do not go together.
    """

    def __init__(
        self, observation_space: gym.Space[Any], action_space: gym.Space[Any], config: Mapping[str, Any]
    ) -> None:
        super().__init__()
        assert isinstance(action_space, gym.spaces.Discrete)
        self.encoder = make_encoder(observation_space, config)
        self.af = nn.Linear(self.encoder.num_features, int(action_space.n))
        self.vf = nn.Linear(self.encoder.num_features, 1) if config["dueling"] else None
        heads = [(head, 1.0) for head in (self.af, self.vf) if head is not None]
        initialize_networks(config, hidden=[self.encoder], heads=heads)


def num_policy_outputs(action_space: gym.Space[Any]) -> int:
    """Mean and log standard deviation of each component, or one logit an action."""
    if isinstance(action_space, gym.spaces.Box):
        return 2 * math.prod(action_space.shape)
    assert isinstance(action_space, gym.spaces.Discrete)
    return int(action_space.n)


def make_encoder(observation_space: gym.Space[Any], config: Mapping[str, Any]) -> Encoder:
    """The encoder that a `model_config` describes.

    Raises:
        SpecError: Convolutions and observations do not go together.
    """
    activation = _OUR_ACTIVATIONS[config["fcnet_activation"]]
    return Encoder(observation_space, config["fcnet_hiddens"], activation, config["conv_filters"])


def initialize_networks(
    config: Mapping[str, Any], *, hidden: list[nn.Module], heads: Sequence[tuple[nn.Module, float]]
) -> None:
    """Set first weights as a `model_config` says; heads come with the gain of orthogonal weights."""
    gain = hidden_gain(_OUR_ACTIVATIONS[config["fcnet_activation"]])
    for module, module_gain in [*((network, gain) for network in hidden), *heads]:
        initialize(module, config["initializer"], module_gain)


def model_config(hyperparams: TrainedHyperparams) -> dict[str, Any]:
    """What RLModules are built from, by RLlib's names where it has one: a user's may extend RLlib's default."""
    filters = hyperparams.conv_filters
    config: dict[str, Any] = {
        "fcnet_hiddens": list(hyperparams.hidden_sizes),
        "fcnet_activation": RLLIB_ACTIVATIONS[hyperparams.activation],
        # The heads are one linear layer each: the portable policy counts on it.
        "head_fcnet_hiddens": [],
        "conv_filters": None if filters is None else [list(item) for item in filters],
        "conv_activation": RLLIB_ACTIVATIONS[hyperparams.activation],
        "initializer": hyperparams.initializer,
        "normalize_observations": hyperparams.normalize_observations,
    }
    if isinstance(hyperparams, PPOHyperparams):
        return {**config, "vf_share_layers": hyperparams.vf_share_layers}
    config |= {
        "double_q": hyperparams.double_q,
        "dueling": hyperparams.dueling,
        "target_network": hyperparams.target_network,
        "exploration": EpsilonSchedule.of(hyperparams).as_config(),
    }
    if hyperparams.epsilon_schedule == "linear":
        start, initial = hyperparams.epsilon_start, hyperparams.epsilon_initial
        after = [start + hyperparams.epsilon_decay, hyperparams.epsilon_final]
        # For subclasses of RLlib's module, which begins at 0 with the first value.
        config["epsilon"] = [[0, initial], *([[start, initial]] if start else []), after]
    return config

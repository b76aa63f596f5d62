"""The networks inside the RLModules of PPO and DQN; they need only torch, so packs build them without loading RLlib.

`policies.networks.rl_modules` builds its modules with these functions, whose order decides which random numbers the
initial weights get.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import torch
from torch import nn

from policies.envs.masks import seen_by_networks
from policies.envs.own_actions import sizes_of
from policies.hyperparams import PPOHyperparams, TrainedHyperparams
from policies.networks.epsilon import EpsilonSchedule
from policies.networks.layers import Encoder, hidden_gain, initialize

# RLlib resolves an activation by these names (its models/utils.py): a torch.nn class name or one of its own.
RLLIB_ACTIVATIONS = {
    "linear": "linear", "relu": "relu", "tanh": "tanh", "silu": "silu", "elu": "elu", "gelu": "GELU",
}  # fmt: skip
_OUR_ACTIVATIONS = {theirs: ours for ours, theirs in RLLIB_ACTIVATIONS.items()}


class PPONetworks(nn.Module):
    """PPO's networks: encoders, the policy head `pi` and the value head `vf`.

    Args:
        observation_space: The environment's.
        action_space: The environment's.
        config: A result of `model_config`.
        inference_only: Leave out the value function's own encoder.

    Raises:
        SpecError: The convolutions do not fit the observations.
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
        if config.get("free_log_std"):  # a checkpoint from before this setting has no such entry
            free_log_std(self.pi)


class DQNNetworks(nn.Module):
    """DQN's networks: an encoder, the head `af` for Q-values or advantages and, if dueling, the value head `vf`.

    Args:
        observation_space: The environment's.
        action_space: The environment's.
        config: A result of `model_config`.

    Raises:
        SpecError: The convolutions do not fit the observations.
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


def free_log_std(head: nn.Linear) -> None:
    """Set the log standard deviations of a policy head to 0 for all observations; their biases alone may learn."""
    num_actions = head.out_features // 2
    with torch.no_grad():
        head.weight[num_actions:] = 0.0
        head.bias[num_actions:] = 0.0


def num_policy_outputs(action_space: gym.Space[Any]) -> int:
    """Return the number of outputs: a mean and a log standard deviation per component, or a logit per value."""
    if isinstance(action_space, gym.spaces.Box):
        return 2 * math.prod(action_space.shape)
    sizes = sizes_of(action_space)
    assert sizes
    return sum(sizes)


def make_encoder(observation_space: gym.Space[Any], config: Mapping[str, Any]) -> Encoder:
    """Return the encoder that a `model_config` describes.

    Raises:
        SpecError: The convolutions do not fit the observations.
    """
    activation = _OUR_ACTIVATIONS[config["fcnet_activation"]]
    return Encoder(
        seen_by_networks(observation_space),
        config["fcnet_hiddens"],
        activation,
        config["conv_filters"],
        normalizes=bool(config.get("normalize_observations")),
    )


def initialize_networks(
    config: Mapping[str, Any], *, hidden: list[nn.Module], heads: Sequence[tuple[nn.Module, float]]
) -> None:
    """Set initial weights as a `model_config` says; each head comes with its gain for orthogonal weights."""
    gain = hidden_gain(_OUR_ACTIVATIONS[config["fcnet_activation"]])
    for module, module_gain in [*((network, gain) for network in hidden), *heads]:
        initialize(module, config["initializer"], module_gain)


def model_config(hyperparams: TrainedHyperparams) -> dict[str, Any]:
    """Return the settings that RLModules are built from, by RLlib's names, as a user's module may extend RLlib's."""
    filters = hyperparams.conv_filters
    config: dict[str, Any] = {
        "fcnet_hiddens": list(hyperparams.hidden_sizes),
        "fcnet_activation": RLLIB_ACTIVATIONS[hyperparams.activation],
        # The heads are one linear layer each: the portable policy relies on it.
        "head_fcnet_hiddens": [],
        "conv_filters": None if filters is None else [list(item) for item in filters],
        "conv_activation": RLLIB_ACTIVATIONS[hyperparams.activation],
        "initializer": hyperparams.initializer,
        "normalize_observations": hyperparams.normalize_observations,
    }
    if isinstance(hyperparams, PPOHyperparams):
        return {**config, "vf_share_layers": hyperparams.vf_share_layers, "free_log_std": hyperparams.free_log_std}
    config |= {
        "double_q": hyperparams.double_q,
        "dueling": hyperparams.dueling,
        "target_network": hyperparams.target_network,
        "exploration": EpsilonSchedule.of(hyperparams).as_config(),
    }
    if hyperparams.epsilon_schedule == "linear":
        start, initial = hyperparams.epsilon_start, hyperparams.epsilon_initial
        after = [start + hyperparams.epsilon_decay, hyperparams.epsilon_final]
        # For subclasses of RLlib's own module, whose schedule has to begin at 0 with the first value.
        config["epsilon"] = [[0, initial], *([[start, initial]] if start else []), after]
    return config

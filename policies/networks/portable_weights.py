"""Turn the greedy part of an RLModule's weights into a portable network, without ray."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.envs.images import image_member
from policies.errors import CheckpointError
from policies.hyperparams import PPOHyperparams, TrainedHyperparams
from policies.networks.layers import normalization_of, observation_scale
from policies.portable.file import ConvLayer, Layer, NetworkKind, Normalization, PolicyNetwork
from policies.portable.network import conv_filters

Weights = Mapping[str, NDArray[Any]]


def network_from_weights(
    weights: Weights, hyperparams: TrainedHyperparams, observation_space: gym.Space[Any], action_space: gym.Space[Any]
) -> PolicyNetwork:
    """Return the greedy part of the weights of one of our RLModules as a chain of layers.

    Args:
        weights: State of a `policies.networks.rl_modules` module, as NumPy arrays.
        hyperparams: The hyperparameters that the module was built from.
        observation_space: The environment's.
        action_space: The environment's.

    Raises:
        CheckpointError: The weights are not those of the network the hyperparameters describe.
    """
    if isinstance(hyperparams, PPOHyperparams):
        # A shared encoder is called "encoder"; separate ones are the actor's and the critic's.
        encoder = "encoder.encoder" if hyperparams.vf_share_layers else "encoder.actor_encoder"
        head = "pi"
        kind: NetworkKind = "gaussian" if isinstance(action_space, gym.spaces.Box) else "categorical"
    else:
        # DQN's head gives Q-values, or advantages if it is dueling: the greedy action is the same for both.
        encoder, head, kind = "encoder", "af", "q_values"
    # Layers with weights are at every other index, with the activations (none if linear) between them.
    step = 1 if hyperparams.activation == "linear" else 2
    filters = hyperparams.conv_filters or ()
    conv = tuple(
        ConvLayer(*_tensors(weights, f"{encoder}.conv.{position * step}"), stride, hyperparams.activation)
        for position, (_, _, stride) in enumerate(filters)
    )
    layers = [
        Layer(*_tensors(weights, f"{encoder}.mlp.{position * step}"), hyperparams.activation)
        for position in range(len(hyperparams.hidden_sizes))
    ]
    layers.append(Layer(*_tensors(weights, head), "linear"))
    network = PolicyNetwork(
        kind=kind,
        layers=tuple(layers),
        conv=conv,
        normalization=normalization_in(weights) if hyperparams.normalize_observations else None,
        scale=observation_scale(observation_space),
        image=image_member(observation_space, normalizes=hyperparams.normalize_observations) if filters else None,
    )
    _check_sizes(network, hyperparams, weights, encoder)
    return network


def check_scale(space: gym.Space[Any], saved: PolicyNetwork) -> None:
    """Check that what networks see of a space is what they saw when a network was saved.

    Former versions divided images of bytes by 255 whatever their space said.

    Raises:
        CheckpointError: It is something else. A network of the user's own scales for itself.
    """
    now = observation_scale(space)
    if saved.module is None and saved.scale != now:
        raise CheckpointError(
            f"It was trained on images of bytes times {saved.scale:.6g}, and this version multiplies them by "
            f"{now:.6g}.",
            "Launch the sweep anew; its policies act as before.",
        )


def _check_sizes(network: PolicyNetwork, hyperparams: TrainedHyperparams, weights: Weights, encoder: str) -> None:
    """Check that the network of the weights is the one that the hyperparameters describe, and not a larger one."""
    num_layers = sum(name.startswith(f"{encoder}.") and name.endswith(".weight") for name in weights)
    filters = hyperparams.conv_filters or ()
    pairs = {
        "hidden layers": ([len(layer.bias) for layer in network.layers[:-1]], list(hyperparams.hidden_sizes)),
        "convolutions": (conv_filters(network.conv), list(filters)),
        "so many convolutions and hidden layers:": (num_layers, len(filters) + len(hyperparams.hidden_sizes)),
        "normalised observations:": ("obs_mean" in weights, hyperparams.normalize_observations),
    }
    for what, (found, expected) in pairs.items():
        if found != expected:
            raise CheckpointError(
                f"The network has {what} {found}, its hyperparameters say {expected}.",
                "Report this: RLlib built another network than the one asked for.",
            )


def _tensors(weights: Weights, name: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the weight and the bias of a layer."""
    return _tensor(weights, f"{name}.weight"), _tensor(weights, f"{name}.bias")


def _tensor(weights: Weights, name: str) -> NDArray[np.float32]:
    if name not in weights:
        raise CheckpointError(
            f"The RLModule has no weights {name!r}; it has {sorted(weights)}.",
            "Only the networks that tune-jobs builds can be made portable.",
        )
    return np.array(weights[name], dtype=np.float32)


def normalization_in(weights: Weights) -> Normalization:
    """Return the observation statistics that a module's weights include."""
    return normalization_of(_tensor(weights, "obs_mean"), _tensor(weights, "obs_var"))

"""RLlib's weights as a portable policy, and an RLlib checkpoint as an `Algorithm` that trains on.

A restore succeeds with the very weights that were saved, or raises: RLlib's own `from_checkpoint` only warns when a
module class cannot be imported or a key is missing, and goes on with fresh weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.core import DEFAULT_MODULE_ID

from policies.errors import CheckpointError
from policies.hyperparams import Hyperparams, PPOHyperparams
from policies.portable import (
    ActionTransform,
    Layer,
    NetworkKind,
    PolicyNetwork,
    PortablePolicy,
    describe_space,
)

Weights = Mapping[str, NDArray[Any]]

_RESTORE_HINT = "Use another checkpoint of the trial; this one cannot be gone on from."


def network_from_weights(weights: Weights, hyperparams: Hyperparams, action_space: gym.Space[Any]) -> PolicyNetwork:
    """The greedy part of an RLlib module's weights as a chain of layers.

    Args:
        weights: State of the default PPO or DQN RLModule, numpy.
        hyperparams: What the module was built from.
        action_space: The environment's.

    Raises:
        CheckpointError: The weights are not those of the network the hyperparameters describe.
    """
    if isinstance(hyperparams, PPOHyperparams):
        # A shared encoder is called just that; separate ones are the actor's and the critic's.
        encoder = "encoder.encoder" if hyperparams.vf_share_layers else "encoder.actor_encoder"
        head = "pi"
        kind: NetworkKind = "gaussian" if isinstance(action_space, gym.spaces.Box) else "categorical"
    else:
        # DQN's first head gives Q-values, or advantages where it is dueling: both have the same greedy action.
        encoder, head, kind = "encoder", "af", "q_values"
    # Linear layers stand at every other place in RLlib's Sequential, the activations (none if linear) between them.
    step = 1 if hyperparams.activation == "linear" else 2
    layers = [
        _layer(weights, f"{encoder}.net.mlp.{position * step}", hyperparams.activation)
        for position in range(len(hyperparams.hidden_sizes))
    ]
    layers.append(_layer(weights, f"{head}.net.mlp.0", "linear"))
    sizes = tuple(len(layer.bias) for layer in layers[:-1])
    if sizes != hyperparams.hidden_sizes:
        raise CheckpointError(
            f"The network has hidden layers {list(sizes)}, its hyperparameters say {list(hyperparams.hidden_sizes)}.",
            "Report this: RLlib built another network than the one asked for.",
        )
    return PolicyNetwork(kind=kind, layers=tuple(layers))


def _layer(weights: Weights, name: str, activation: str) -> Layer:
    try:
        weight, bias = weights[f"{name}.weight"], weights[f"{name}.bias"]
    except KeyError as error:
        raise CheckpointError(
            f"The RLModule has no weights {error.args[0]!r}; it has {sorted(weights)}.",
            "Only the networks that tune-jobs builds can be made portable.",
        ) from error
    return Layer(np.array(weight, dtype=np.float32), np.array(bias, dtype=np.float32), activation)


def portable_policy(
    algorithm: Algorithm,
    hyperparams: Hyperparams,
    *,
    env_id: str,
    env_args: dict[str, Any],
    training: dict[str, Any] | None = None,
) -> PortablePolicy:
    """The greedy policy of a running Algorithm, with all that is needed to act without RLlib.

    Raises:
        CheckpointError: Its network is not the one the hyperparameters describe.
    """
    weights = learner_weights(algorithm)
    config = algorithm.config
    module = algorithm.get_module()
    observation_space, action_space = module.observation_space, module.action_space
    transform: ActionTransform = "none"
    if isinstance(action_space, gym.spaces.Box):
        transform = "unsquash" if config.normalize_actions else "clip" if config.clip_actions else "none"
    return PortablePolicy(
        network=network_from_weights(weights, hyperparams, action_space),
        algorithm="ppo" if isinstance(hyperparams, PPOHyperparams) else "dqn",
        env_id=env_id,
        env_args=env_args,
        observation_space=describe_space(observation_space),
        action_space=describe_space(action_space),
        action_transform=transform,
        training=training or {},
    )


def learner_weights(algorithm: Algorithm) -> dict[str, NDArray[Any]]:
    """The learner's weights of the one RLModule, as numpy arrays."""
    weights: dict[str, NDArray[Any]] = algorithm.learner_group.get_weights()[DEFAULT_MODULE_ID]
    return weights


def restore_algorithm(rllib_checkpoint: Path, expected: PolicyNetwork | None = None) -> Algorithm:
    """Restore an RLlib checkpoint as an `Algorithm` that can train on.

    RLlib's checkpoints are pickles: restore only what you trust. Callers check the manifest's hashes first.

    Args:
        rllib_checkpoint: The folder RLlib's `save_to_path` wrote.
        expected: The network that was saved beside it; the restored weights must be equal to it.

    Raises:
        CheckpointError: RLlib cannot restore it, or the weights are not the expected ones.
    """
    try:
        algorithm = Algorithm.from_checkpoint(str(rllib_checkpoint.absolute()))
    except Exception as error:
        raise CheckpointError(f"RLlib cannot restore {rllib_checkpoint}: {error!r}.", _RESTORE_HINT) from error
    if expected is not None:
        try:
            check_weights(algorithm, expected)
        except CheckpointError as error:
            algorithm.stop()
            raise CheckpointError(f"{rllib_checkpoint}: {error.message}", _RESTORE_HINT) from error
    return algorithm


def check_weights(algorithm: Algorithm, expected: PolicyNetwork) -> None:
    """Check that an Algorithm's learner and its env runner hold a network's very weights.

    Raises:
        CheckpointError: They differ.
    """
    runner = algorithm.env_runner
    sources = {"learner": learner_weights(algorithm)}
    if runner is not None and runner.module is not None:
        sources["env runner"] = runner.module.get_state()
    for source, weights in sources.items():
        held = {array.tobytes() for array in (np.asarray(value, dtype=np.float32) for value in weights.values())}
        for number, layer in enumerate(expected.layers):
            if layer.weight.tobytes() not in held or layer.bias.tobytes() not in held:
                raise CheckpointError(
                    f"the restored {source} does not hold the saved weights of layer {number}.", _RESTORE_HINT
                )

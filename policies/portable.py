"""The portable policy file: what it takes to act, without Ray, torch or pickle.

It is a pair of files side by side. `policy.safetensors` holds the weights; `policy.json` says what network
they form, which environment it acts in and how it was trained, and carries the SHA-256 of the weights. Words:
a *layer* is a linear map followed by an activation; the *network* is the chain of layers from observation to
output; what the output means is the network's *kind*:

* `categorical` (PPO, Discrete actions): one logit an action; greedy: the largest.
* `gaussian` (PPO, Box actions): mean and log standard deviation of each component; greedy: the mean.
* `q_values` (DQN): one value an action; greedy: the largest. Of a dueling network the layers end in the
  advantages: the state value is the same for all actions, so it never changes which one is greedy, and is
  left out.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.errors import CheckpointError, NotFoundError
from policies.files import write_atomic
from policies.hyperparams import ACTIVATIONS

FORMAT_VERSION = 1

NetworkKind = Literal["categorical", "gaussian", "q_values"]
ActionTransform = Literal["none", "unsquash", "clip"]


@dataclass(frozen=True, eq=False)
class Layer:
    """One linear map and the activation after it: `activation(weight @ x + bias)`."""

    weight: NDArray[np.float32]
    """Shape (num_outputs, num_inputs)."""
    bias: NDArray[np.float32]
    """Shape (num_outputs,)."""
    activation: str = "linear"
    """A name of `policies.hyperparams.ACTIVATIONS`."""


@dataclass(frozen=True, eq=False)
class PolicyNetwork:
    """The layers from observation to output, and what the output means (see the module)."""

    kind: NetworkKind
    layers: tuple[Layer, ...]


@dataclass(frozen=True, eq=False)
class PortablePolicy:
    """A network and all that is needed to let it act in its environment."""

    network: PolicyNetwork
    algorithm: str
    env_id: str
    env_args: dict[str, Any]
    observation_space: dict[str, Any]
    """As `describe_space` gives it."""
    action_space: dict[str, Any]
    action_transform: ActionTransform = "none"
    """What turns a Box action of the network into one of the env: see `policies.policy`."""
    training: dict[str, Any] = field(default_factory=dict)
    """Where it comes from: trial id, iteration, hyperparameters, seed, ... Free, and not needed to act."""


def describe_space(space: gym.Space[Any]) -> dict[str, Any]:
    """A Box or Discrete space as a JSON object; infinite bounds become the strings "inf" and "-inf".

    Raises:
        CheckpointError: A space of another kind.
    """
    if isinstance(space, gym.spaces.Box):
        return {
            "type": "box",
            "shape": [int(size) for size in space.shape],
            "low": _numbers_to_json(space.low.tolist()),
            "high": _numbers_to_json(space.high.tolist()),
            "dtype": str(space.dtype),
        }
    if isinstance(space, gym.spaces.Discrete):
        return {"type": "discrete", "n": int(space.n), "start": int(space.start)}
    raise CheckpointError(
        f"A policy file cannot describe a space of kind {type(space).__name__}.",
        "Use Box or Discrete spaces.",
    )


def space_from_description(description: Mapping[str, Any]) -> gym.spaces.Box | gym.spaces.Discrete[Any]:
    """The space that `describe_space` described.

    Raises:
        CheckpointError: The description is incomplete or contradicts itself.
    """
    try:
        if description["type"] == "discrete":
            return gym.spaces.Discrete(int(description["n"]), start=int(description.get("start", 0)))
        if description["type"] == "box":
            dtype = np.dtype(description["dtype"])
            low, high = (np.array(_numbers_from_json(description[key]), dtype=dtype) for key in ("low", "high"))
            shape = tuple(int(size) for size in description["shape"])
            return gym.spaces.Box(low.reshape(shape), high.reshape(shape), shape, dtype.type)
    except (KeyError, TypeError, ValueError, AssertionError) as error:
        raise CheckpointError(
            f"A space is described as {dict(description)!r}, which makes none: {error}.",
            "Write the policy file again from its checkpoint.",
        ) from error
    raise CheckpointError(
        f"A space is described as of type {description['type']!r}; known are 'box' and 'discrete'.",
        "Write the policy file again from its checkpoint, or update tune-jobs.",
    )


def save_policy(policy: PortablePolicy, folder: Path, stem: str = "policy") -> Path:
    """Write `<stem>.safetensors` and `<stem>.json` into a folder.

    Each file appears whole or not at all, the weights first, so an interrupted save never leaves a JSON file
    without its weights; the hash in it tells if the weights beside it are those of another save.

    Returns:
        The path of the JSON file.

    Raises:
        CheckpointError: The layers do not form a network that maps the observations to the actions.
        CannotRunError: The folder cannot be written.
    """
    from safetensors.numpy import save

    _check(policy, f"policy to save as {folder / stem}")
    # Contiguous: safetensors writes the memory as it lies, so a transposed view would be written transposed.
    tensors = {}
    for index, layer in enumerate(policy.network.layers):
        tensors[f"layers.{index}.weight"] = np.ascontiguousarray(layer.weight, dtype=np.float32)
        tensors[f"layers.{index}.bias"] = np.ascontiguousarray(layer.bias, dtype=np.float32)
    weights: bytes = save(tensors)
    description = {
        "format_version": FORMAT_VERSION,
        "algorithm": policy.algorithm,
        "env_id": policy.env_id,
        "env_args": policy.env_args,
        "observation_space": policy.observation_space,
        "action_space": policy.action_space,
        "action_transform": policy.action_transform,
        "network": {
            "kind": policy.network.kind,
            "activations": [layer.activation for layer in policy.network.layers],
            "sizes": [layer.weight.shape[0] for layer in policy.network.layers],
        },
        "weights_sha256": hashlib.sha256(weights).hexdigest(),
        "training": policy.training,
    }
    write_atomic(folder / f"{stem}.safetensors", weights)
    write_atomic(folder / f"{stem}.json", json.dumps(_jsonable(description), indent=2, allow_nan=False) + "\n")
    return folder / f"{stem}.json"


def read_policy(path: Path) -> PortablePolicy:
    """Read a portable policy; nothing in the files is executed.

    Args:
        path: The JSON file, the safetensors file beside it, or a folder that holds `policy.json`.

    Raises:
        NotFoundError: One of the two files is not there.
        CheckpointError: The files do not belong together, were altered, or are of another format.
    """
    json_path, weights_path = _locate(Path(path))
    try:
        description = json.loads(json_path.read_text(encoding="utf-8"))
        weights = weights_path.read_bytes()
    except ValueError as error:  # JSON and UTF-8 errors are both ValueErrors
        raise _broken(json_path, f"is not JSON: {error}") from error
    except OSError as error:
        raise NotFoundError(
            f"The policy file {json_path} cannot be read: {error.strerror}.", "Check its permissions."
        ) from error
    if not isinstance(description, dict) or "format_version" not in description:
        raise _broken(json_path, "is not a policy file: it has no format_version")
    version = description["format_version"]
    if version != FORMAT_VERSION:
        raise CheckpointError(
            f"The policy file {json_path} has format version {version!r}; this tune-jobs reads {FORMAT_VERSION}.",
            "Update tune-jobs, or write the policy file again from its checkpoint.",
        )
    digest = hashlib.sha256(weights).hexdigest()
    if digest != description.get("weights_sha256"):
        raise _broken(
            weights_path,
            f"has SHA-256 {digest[:12]}..., but {json_path.name} names "
            f"{str(description.get('weights_sha256'))[:12]}...",
        )
    policy = _assemble(description, weights, json_path)
    _check(policy, f"policy file {json_path}")
    return policy


def _locate(path: Path) -> tuple[Path, Path]:
    if path.is_dir():
        path = path / "policy.json"
    elif path.suffix not in {".json", ".safetensors"}:
        if not path.exists():
            raise NotFoundError(f"There is no policy file {path}.", "Give a policy.json, or the folder that holds one.")
        raise CheckpointError(
            f"{path} is not a policy file: its name ends in neither .json nor .safetensors.",
            "Give a policy.json, or the folder that holds one.",
        )
    pair = (path.with_suffix(".json"), path.with_suffix(".safetensors"))
    for file in pair:
        if not file.is_file():
            raise NotFoundError(
                f"There is no policy file {file}.",
                "Give a policy.json with its .safetensors beside it, or the folder that holds both.",
            )
    return pair


def _broken(path: Path, what: str) -> CheckpointError:
    return CheckpointError(
        f"The policy file {path} {what}.",
        "It is incomplete or was altered: copy both files again, or write them again from the checkpoint.",
    )


def _assemble(description: dict[str, Any], weights: bytes, place: Path) -> PortablePolicy:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        tensors = load(weights)
        network = description["network"]
        layers = tuple(
            Layer(tensors.pop(f"layers.{index}.weight"), tensors.pop(f"layers.{index}.bias"), str(activation))
            for index, activation in enumerate(network["activations"])
        )
        if tensors:
            raise _broken(place, f"does not describe the tensors {sorted(tensors)}")
        return PortablePolicy(
            network=PolicyNetwork(network["kind"], layers),
            algorithm=str(description["algorithm"]),
            env_id=str(description["env_id"]),
            env_args=dict(description["env_args"]),
            observation_space=dict(description["observation_space"]),
            action_space=dict(description["action_space"]),
            action_transform=description["action_transform"],
            training=dict(description.get("training") or {}),
        )
    except KeyError as error:
        raise _broken(place, f"lacks {error}") from error
    except (SafetensorError, TypeError, ValueError) as error:
        raise _broken(place, f"cannot be read: {error}") from error


def _check(policy: PortablePolicy, place: str) -> None:
    """Check that the layers chain from the observations to the actions.

    Raises:
        CheckpointError: They do not, or a name is unknown.
    """
    observation_space = space_from_description(policy.observation_space)
    action_space = space_from_description(policy.action_space)
    kind, transform = policy.network.kind, policy.action_transform
    if kind not in get_args(NetworkKind):
        problem = f"network kind {kind!r} is none of {', '.join(get_args(NetworkKind))}"
    elif transform not in get_args(ActionTransform):
        problem = f"action transform {transform!r} is none of {', '.join(get_args(ActionTransform))}"
    elif isinstance(action_space, gym.spaces.Box) is not (kind == "gaussian"):
        problem = f"a network of kind {kind!r} gives no actions of type {policy.action_space['type']!r}"
    else:
        num_actions = (
            2 * math.prod(action_space.shape) if isinstance(action_space, gym.spaces.Box) else int(action_space.n)
        )
        problem = _layers_problem(policy.network.layers, math.prod(observation_space.shape or ()), num_actions)
    if problem:
        raise CheckpointError(f"Wrong {place}: {problem}.", "Write the policy file again from its checkpoint.")


def _layers_problem(layers: tuple[Layer, ...], num_inputs: int, num_outputs: int) -> str:
    """Why the layers do not map so many inputs to so many outputs; empty if they do."""
    size = num_inputs
    for index, layer in enumerate(layers):
        weight, bias = layer.weight, layer.bias
        if layer.activation not in ACTIVATIONS:
            return f"layer {index} has activation {layer.activation!r}; known are {', '.join(ACTIVATIONS)}"
        if weight.ndim != 2 or weight.shape[1] != size:
            return f"layer {index} has weights of shape {weight.shape}, but its input has {size} numbers"
        if bias.shape != weight.shape[:1]:
            return f"layer {index} has a bias of shape {bias.shape} but weights of shape {weight.shape}"
        size = weight.shape[0]
    if not layers:
        return "the network has no layers"
    return "" if size == num_outputs else f"the network has {size} outputs, but its actions need {num_outputs}"


def _numbers_to_json(value: Any) -> Any:
    if isinstance(value, list):
        return [_numbers_to_json(item) for item in value]
    return str(float(value)) if isinstance(value, float) and not math.isfinite(value) else value


def _numbers_from_json(value: Any) -> Any:
    return [_numbers_from_json(item) for item in value] if isinstance(value, list) else float(value)


def _jsonable(value: Any) -> Any:
    """Metadata as JSON has it: NumPy scalars as numbers, tuples as lists, NaN and infinity as null."""
    if isinstance(value, Mapping):
        return {str(key): _jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_jsonable(item) for item in value]
    if isinstance(value, np.ndarray):
        return _jsonable(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (str, int, float, bool)) or value is None else str(value)

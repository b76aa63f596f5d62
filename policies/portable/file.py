"""Write and read the portable policy file: all that a policy needs to act, without Ray, torch or pickle.

It is a pair of files side by side. `policy.safetensors` holds the weights; `policy.json` says what network
they form (see `policies.portable.network`), which environment it acts in and how it was trained, and carries the
SHA-256 of the weights.

Formats: version 1 had only layers; version 2 has all that `policies.portable.network` describes, and writes the bounds
of a space as one number where they are all equal. Both can be read. The space of observations says what of them is a
mask of actions, null for nothing; where it does not say, the file is of a version that knew no masks.

JSON has no infinity and no NaN. In the arguments of an environment and of a user's own network, which decide what is
made, they are objects such as {"$float": "-Infinity"}, and are read back as what they were; files of older versions
have null there. In metadata they are null.
"""

from __future__ import annotations

import hashlib
import json
import math
import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from policies.envs.mask_settings import ACTION_MASK
from policies.envs.spaces import describe_space, space_from_description
from policies.errors import MALFORMED, CheckpointError, NotFoundError
from policies.files import read_regular, write_atomic
from policies.portable.network import (
    BASELINE_KINDS,
    ConvLayer,
    Layer,
    ModuleWeights,
    NetworkKind,
    Normalization,
    PolicyNetwork,
    action_problem,
    network_from_json,
    network_problem,
    network_to_json,
)

__all__ = [
    "BASELINE_KINDS", "FORMAT_VERSION", "ActionTransform", "ConvLayer", "Layer", "ModuleWeights", "NetworkKind",
    "Normalization", "PolicyNetwork", "PortablePolicy", "action_problem", "describe_space", "policy_files",
    "read_policy", "save_policy", "space_from_description",
]  # fmt: skip

FORMAT_VERSION = 2
READABLE_VERSIONS = (1, 2)
_FLOAT, _MASK = "$float", "mask"
_NON_FINITE = {"Infinity": math.inf, "-Infinity": -math.inf, "NaN": math.nan}
_MAX_CHARS = 400
"""The most characters of a problem that a message quotes."""

ActionTransform = Literal["none", "unsquash", "by_component", "clip"]


@dataclass(frozen=True, eq=False)
class PortablePolicy:
    """A network and all that it needs to act in its environment."""

    network: PolicyNetwork
    algorithm: str
    env_id: str
    env_args: dict[str, Any]
    observation_space: dict[str, Any]
    """The space as `describe_space` describes it."""
    action_space: dict[str, Any]
    action_transform: ActionTransform = "none"
    """The name of how the network's Box actions become the env's; see `policies.acting.policy`."""
    training: dict[str, Any] = field(default_factory=dict)
    """Free metadata on its training, such as trial id, iteration, hyperparameters and seed; not needed to act."""

    @property
    def needs_mask(self) -> bool:
        """Whether it is told beside an observation which actions are allowed, as the observation does not tell."""
        mask = self.observation_space.get(_MASK)
        return isinstance(mask, dict) and mask.get("key") is None


def save_policy(
    policy: PortablePolicy,
    folder: Path,
    stem: str = "policy",
    *,
    write: Callable[[Path, bytes | str], None] = write_atomic,
) -> Path:
    """Write `<stem>.safetensors` and `<stem>.json` into a folder.

    Each file appears whole or not at all, the weights first, so an interrupted save never leaves a JSON file
    without its weights. The hash in the JSON file shows whether the weights beside it come from another save.

    Args:
        policy: The policy to write.
        folder: The folder to write to.
        stem: The name of the files without their suffixes.
        write: Writes a file; `write_plain` if the folder is not visible to readers yet.

    Returns:
        The path of the JSON file.

    Raises:
        CheckpointError: The network does not map the observations to the actions.
        CannotRunError: The folder cannot be written.
    """
    from safetensors.numpy import save

    _check(policy, f"policy to save as {folder / stem}")
    network, tensors = network_to_json(policy.network)
    if "module" in network:
        network["module"]["model_config"] = _jsonable(network["module"]["model_config"], exact=True)
    weights: bytes = save(tensors)
    description = {
        "format_version": FORMAT_VERSION,
        "algorithm": policy.algorithm,
        "env_id": policy.env_id,
        "env_args": _jsonable(policy.env_args, exact=True),
        "observation_space": {_MASK: None} | policy.observation_space,
        "action_space": policy.action_space,
        "action_transform": policy.action_transform,
        "network": network,
        "weights_sha256": hashlib.sha256(weights).hexdigest(),
        "training": policy.training,
    }
    write(folder / f"{stem}.safetensors", weights)
    write(folder / f"{stem}.json", json.dumps(_jsonable(description), indent=2, allow_nan=False) + "\n")
    return folder / f"{stem}.json"


def policy_files(folder: Path) -> dict[str, Path]:
    """Return the files of the policy in a folder by their names; none if it lacks one of them."""
    files = {name: folder / name for name in ("policy.json", "policy.safetensors")}
    return files if all(path.is_file() for path in files.values()) else {}


def is_policy_folder(folder: Path) -> bool:
    """Whether a folder holds a policy, judged by the name of its file; its content is not looked at.

    Raises:
        NotFoundError: This cannot be found out.
    """
    return stat.S_ISREG(_mode(folder / "policy.json"))


def read_policy(path: Path) -> PortablePolicy:
    """Read a portable policy; nothing in the files is executed.

    Args:
        path: The JSON file, the safetensors file beside it, or a folder that holds `policy.json`.

    Raises:
        NotFoundError: One of the two files is not there, or cannot be read.
        CheckpointError: The files do not belong together, were altered, or have another format.
    """
    json_path, weights_path = _locate(Path(path))
    try:
        description = json.loads(read_regular(json_path))
        weights = read_regular(weights_path, max_bytes=None)
    except (ValueError, RecursionError, MemoryError) as error:  # JSON and UTF-8 errors are both ValueErrors
        raise _broken(json_path, f"is not JSON: {error}") from error
    except OSError as error:
        raise _unreadable(json_path, error) from error
    if not isinstance(description, dict) or "format_version" not in description:
        raise _broken(json_path, "is not a policy file: it has no format_version")
    version = description["format_version"]
    if version not in READABLE_VERSIONS:
        known = " and ".join(str(number) for number in READABLE_VERSIONS)
        raise CheckpointError(
            f"The policy file {json_path} has format version {repr(version)[:80]}; this tune-jobs reads {known}.",
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
    mode = _mode(path)
    if stat.S_ISDIR(mode):
        path = path / "policy.json"
    elif path.suffix not in {".json", ".safetensors"}:
        if not mode:
            raise NotFoundError(f"There is no policy file {path}.", "Give a policy.json, or the folder that holds one.")
        raise CheckpointError(
            f"{path} is not a policy file: its name ends in neither .json nor .safetensors.",
            "Give a policy.json, or the folder that holds one.",
        )
    pair = (path.with_suffix(".json"), path.with_suffix(".safetensors"))
    for file in pair:
        if not stat.S_ISREG(_mode(file)):
            raise NotFoundError(
                f"There is no policy file {file}.",
                "Give a policy.json with its .safetensors beside it, or the folder that holds both.",
            )
    return pair


def _mode(path: Path) -> int:
    """Return the mode of what is at a path; 0: there is nothing.

    Raises:
        NotFoundError: This cannot be found out. (`Path.is_file` would raise an error of the system, or answer False.)
    """
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError, ValueError):  # a NUL is in it
        return 0
    except OSError as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: OSError) -> NotFoundError:
    return NotFoundError(
        f"The policy file {path} cannot be read: {error.strerror}.",
        "Check its permissions, and those of the folders above it.",
    )


def _broken(path: Path, what: str) -> CheckpointError:
    return CheckpointError(
        f"The policy file {path} {what[:_MAX_CHARS]}.",
        "It is incomplete or was altered: copy both files again, or write them again from the checkpoint.",
    )


def _assemble(description: dict[str, Any], weights: bytes, place: Path) -> PortablePolicy:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        tensors = load(weights)
        network = network_from_json(_with_exact_arguments(description["network"]), tensors)
        if tensors:
            raise _broken(place, f"does not describe the tensors {sorted(tensors)}")
        return PortablePolicy(
            network=network,
            algorithm=str(description["algorithm"]),
            env_id=str(description["env_id"]),
            env_args=_env_args(description),
            observation_space=_observation_space(description),
            action_space=dict(description["action_space"]),
            action_transform=description["action_transform"],
            training=dict(description.get("training") or {}),
        )
    except KeyError as error:
        raise _broken(place, f"lacks {error}") from error
    except (SafetensorError, *MALFORMED) as error:
        raise _broken(place, f"cannot be read: {error}") from error


def _check(policy: PortablePolicy, place: str) -> None:
    """Check that the network maps the observations to the actions.

    Raises:
        CheckpointError: It does not map them, or a name is unknown.
    """
    observation_space = space_from_description(policy.observation_space)
    action_space = space_from_description(policy.action_space)
    problem = network_problem(policy.network, observation_space, action_space)
    if policy.action_transform not in get_args(ActionTransform):
        problem = f"action transform {policy.action_transform!r} is none of {', '.join(get_args(ActionTransform))}"
    if problem:
        raise CheckpointError(
            f"Wrong {place}: {problem[:_MAX_CHARS]}.", "Write the policy file again from its checkpoint."
        )


def _jsonable(value: Any, *, exact: bool = False) -> Any:
    """Return a value in JSON's types: NumPy scalars as numbers, tuples as lists.

    NaN and infinity become null; or, if it is to be exact, what `_from_exact` makes the same number again.
    """
    if isinstance(value, Mapping):
        return {str(key): _jsonable(item, exact=exact) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_jsonable(item, exact=exact) for item in value]
    if isinstance(value, np.ndarray):
        return _jsonable(value.tolist(), exact=exact)
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        sign = "-" if value < 0 else ""
        return {_FLOAT: "NaN" if math.isnan(value) else f"{sign}Infinity"} if exact else None
    return value if isinstance(value, (str, int, float, bool)) or value is None else str(value)


def _env_args(description: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of a policy's environment.

    Raises:
        KeyError, TypeError, ValueError: There are none.
    """
    env_args = {key: _from_exact(value) for key, value in dict(description["env_args"]).items()}
    # Versions that knew no masks trained without the one that the environment may have.
    return env_args if _MASK in description["observation_space"] else {ACTION_MASK: False} | env_args


def _observation_space(description: Mapping[str, Any]) -> dict[str, Any]:
    """Return the description of a policy's observations, without a mask that there is none of.

    Raises:
        KeyError, TypeError, ValueError: There is no description.
    """
    space = dict(description["observation_space"])
    return space if space.get(_MASK) is not None else {key: space[key] for key in space if key != _MASK}


def _from_exact(value: Any) -> Any:
    """Return a value of a file with the numbers that JSON has no words for."""
    if isinstance(value, list):
        return [_from_exact(item) for item in value]
    if not isinstance(value, dict):
        return value
    if len(value) == 1 and isinstance(word := value.get(_FLOAT), str) and word in _NON_FINITE:
        return _NON_FINITE[word]
    return {key: _from_exact(item) for key, item in value.items()}


def _with_exact_arguments(network: dict[str, Any]) -> dict[str, Any]:
    """Return the description of a network with the arguments of a user's own class as they were.

    Raises:
        KeyError, TypeError, ValueError: It is no description of a network.
    """
    if "module" not in network:
        return network
    module = dict(network["module"])
    return {**network, "module": {**module, "model_config": _from_exact(module["model_config"])}}

"""Write members to disk and read them, as safetensors and JSON, which execute nothing when they are read."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any, cast

import numpy as np

from policies.errors import MALFORMED, UPGRADE, CheckpointError
from policies.files import write_plain
from policies.hyperparams import Algorithm, Hyperparams, PPOHyperparams, TrainedHyperparams, make_hyperparams
from policies.packed.member import OBS_COUNT, OBS_MEAN, OBS_VAR, TARGET_PREFIX, AnyMember, Member, Weights
from policies.return_statistics import ReturnStatistics

STATE_FOLDER = "packed"
_FORMAT_VERSION = 1
_TENSORS, _JSON = "state.safetensors", "state.json"
_COUNTERS = (
    "num_optimizer_steps", "num_env_steps", "num_episodes", "num_iterations", "num_updates", "kl_coeff", "due",
    "target_updates_at", "num_target_updates",
)  # fmt: skip
_WEIGHTS = "weights"
_RETURNS = "return_statistics"
_STATISTICS = (OBS_MEAN, OBS_VAR, OBS_COUNT)
_MOMENTS = ({"exp_avg", "exp_avg_sq"}, {"square_avg", "momentum_buffer"}, {"square_avg"})
"""The names of the moments of Adam, and of RMSprop with and without momentum."""
_HINT = "Use another checkpoint of the trial; training cannot continue from this one."


def save_member(member: AnyMember, folder: Path) -> None:
    """Write a member into a new folder.

    Args:
        member: A member whose weights were written back.
        folder: The folder for `state.safetensors` and `state.json`.
    """
    from safetensors.numpy import save

    folder.mkdir(parents=True, exist_ok=True)
    # ascontiguousarray would make an array of one element from a single number.
    tensors = {f"{_WEIGHTS}/{name}": np.asarray(value, order="C") for name, value in member.weights.items()}
    for moment, weights in member.moments.items():
        tensors |= {f"{moment}/{name}": np.asarray(value, order="C") for name, value in weights.items()}
    description = {
        "format_version": _FORMAT_VERSION,
        "algorithm": "ppo" if isinstance(member.hyperparams, PPOHyperparams) else "dqn",
        "hyperparams": member.hyperparams.model_dump(mode="json"),
        "seed": member.seed,
        "counters": {name: getattr(member, name) for name in _COUNTERS},
        "failure_penalty": member.failure_penalty,
        "atari_training": member.atari_training,
        **({_RETURNS: vars(member.return_statistics)} if _normalizes_rewards(member.hyperparams) else {}),
        "rng": member.rng.bit_generator.state,
    }
    write_plain(folder / _TENSORS, save(tensors))
    write_plain(folder / _JSON, json.dumps(description, indent=1) + "\n")


def load_member(folder: Path, member_id: str) -> AnyMember:
    """Read a member.

    Args:
        folder: A folder that `save_member` wrote; callers check the manifest's hashes first.
        member_id: The member's id from now on.

    Raises:
        CheckpointError: Something is missing or damaged, or was written by a newer version.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        description: dict[str, Any] = json.loads((folder / _JSON).read_bytes())
        tensors = load((folder / _TENSORS).read_bytes())
        if description["format_version"] > _FORMAT_VERSION:
            raise CheckpointError(
                f"{folder / _JSON} has format version {str(description['format_version'])[:80]}; this tune-jobs reads "
                f"up to {_FORMAT_VERSION}.",
                UPGRADE,
            )
        hyperparams = make_hyperparams(cast("Algorithm", description["algorithm"]), description["hyperparams"])
        rng = np.random.Generator(np.random.PCG64())
        rng.bit_generator.state = description["rng"]
        parts: dict[str, Weights] = {}
        for name, value in tensors.items():
            part, _, weight = name.partition("/")
            parts.setdefault(part, {})[weight] = value
        return Member(
            member_id,
            cast("TrainedHyperparams", hyperparams),
            int(description["seed"]),
            weights=parts.pop(_WEIGHTS),
            moments=parts,
            rng=rng,
            failure_penalty=None if description["failure_penalty"] is None else _number(description["failure_penalty"]),
            # Written since later than the format's first files.
            atari_training=_switches(description.get("atari_training")),
            return_statistics=_return_statistics(description, hyperparams),
            **cast("Any", {name: _number(description["counters"][name]) for name in _COUNTERS}),
        )
    except (OSError, SafetensorError, *MALFORMED) as error:
        raise CheckpointError(f"{folder} does not hold a member's state: {repr(error)[:400]}.", _HINT) from error


def _normalizes_rewards(hyperparams: Hyperparams) -> bool:
    return isinstance(hyperparams, PPOHyperparams) and hyperparams.normalize_rewards


def _return_statistics(description: dict[str, Any], hyperparams: Hyperparams) -> ReturnStatistics:
    """Return the statistics that rewards are normalised by; without them the policy's rewards would change scale."""
    if not _normalizes_rewards(hyperparams):
        return ReturnStatistics()
    saved = description[_RETURNS]
    return ReturnStatistics(**{item.name: float(_number(saved[item.name])) for item in fields(ReturnStatistics)})


def _number(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{value!r} is no number")
    return value


def _switches(value: Any) -> dict[str, bool] | None:
    if value is None:
        return None
    if not isinstance(value, dict) or not all(isinstance(switch, bool) for switch in value.values()):
        raise TypeError(f"{value!r} is no mapping to true or false")
    return value


def check_shapes(member: AnyMember, expected: Weights) -> None:
    """Check that a member's weights have the shapes that its hyperparameters describe.

    Args:
        member: A member that was read.
        expected: Weights of a new member with the same hyperparameters.

    Raises:
        CheckpointError: A shape differs, or weights are missing.
    """
    for part, weights in {_WEIGHTS: member.weights, **member.moments}.items():
        for name, value in weights.items():
            known = expected.get(name)
            if known is None or known.shape != value.shape:
                shape = "none" if known is None else known.shape
                raise CheckpointError(
                    f"The saved {part} {name} have shape {value.shape}, the network's have {shape}.", _HINT
                )
    trained = {name for name in expected if not name.startswith((*_STATISTICS, TARGET_PREFIX))}
    for part, needed in {_WEIGHTS: set(expected), **dict.fromkeys(member.moments, trained)}.items():
        found = member.weights if part == _WEIGHTS else member.moments[part]
        if missing := sorted(needed - set(found)):
            raise CheckpointError(f"The saved {part} lack {', '.join(missing)}.", _HINT)
    if member.num_optimizer_steps and set(member.moments) not in _MOMENTS:
        raise CheckpointError(f"The optimizer's moments are {', '.join(member.moments) or 'missing'}.", _HINT)

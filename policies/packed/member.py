"""What a pack knows of each of its members, and how an RLModule's weights lie in a stack's rows.

Names of weights are those of `policies.networks.rl_modules`' modules, so that a member can leave for RLlib and come
from it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from policies.hyperparams import DQNHyperparams, PPOHyperparams, TrainedHyperparams

Weights = dict[str, NDArray[Any]]

OBS_MEAN, OBS_VAR, OBS_COUNT = "obs_mean", "obs_var", "obs_count"
TARGET_PREFIX = "_target_"


H = TypeVar("H", bound=TrainedHyperparams)
H_co = TypeVar("H_co", bound=TrainedHyperparams, covariant=True)


@dataclass(eq=False)
class Member(Generic[H_co]):
    """One trial of a pack: all that training it on needs, but for its running episodes and its replay memory.

    The weights and moments here are those of the last time its stack wrote them back.
    """

    member_id: str
    hyperparams: H_co
    seed: int
    weights: Weights
    """By the RLModule's names, target networks (`_target_...`) and observation statistics among them."""
    moments: dict[str, Weights] = field(default_factory=dict)
    """The optimizer's, by torch's names (`exp_avg`) and the weights'; empty: none yet."""
    num_optimizer_steps: int = 0
    num_env_steps: int = 0
    num_episodes: int = 0
    num_iterations: int = 0
    num_updates: int = 0
    kl_coeff: float = 0.0
    """PPO: weight of the KL penalty now."""
    due: float = 0.0
    """DQN: updates that are due but not made."""
    target_updates_at: float = 0.0
    """DQN: env steps or episodes at the last target update."""
    num_target_updates: int = 0
    failure_penalty: float | None = None
    """Of its environments: reward of steps that end by failure; None: their own."""
    rng: np.random.Generator = field(kw_only=True)
    """Draws actions, permutations and batches."""


AnyMember = Member[TrainedHyperparams]
"""Of PPO or DQN."""


@dataclass(frozen=True)
class MemberStats:
    """What one iteration gave a member."""

    num_env_steps: int
    episodes: tuple[tuple[float, int], ...]
    """(undiscounted return, env steps) of each whole episode that ended in it, oldest first."""
    learner: dict[str, float]


@dataclass(frozen=True)
class Part:
    """Some columns of a layer: one linear layer of the RLModule."""

    name: str
    start: int
    stop: int


@dataclass(frozen=True)
class NetworkLayout:
    """Which linear layers of the RLModule make one network of a stack, from input to output."""

    layers: tuple[tuple[Part, ...], ...]

    def write(self, layers: Sequence[Tensor], weights: Mapping[str, NDArray[Any]], prefix: str = "") -> None:
        """Put an RLModule's weights into the layers of one row, shape (inputs + 1, outputs) each."""
        for parts, layer in zip(self.layers, layers, strict=True):
            for part in parts:
                matrix = torch.from_numpy(np.ascontiguousarray(weights[f"{prefix}{part.name}.weight"].T))
                layer[: len(matrix), part.start : part.stop] = matrix
                layer[-1, part.start : part.stop] = torch.from_numpy(weights[f"{prefix}{part.name}.bias"])

    def read(self, layers: Sequence[Tensor], num_inputs: int, prefix: str = "") -> Weights:
        """The inverse of `write`."""
        weights: Weights = {}
        for parts, layer in zip(self.layers, layers, strict=True):
            for part in parts:
                columns = layer[:, part.start : part.stop].detach().cpu().numpy()
                weights[f"{prefix}{part.name}.weight"] = np.array(columns[:num_inputs].T, order="C")
                weights[f"{prefix}{part.name}.bias"] = np.array(columns[-1])
            num_inputs = parts[-1].stop
        return weights


def network_layouts(hyperparams: TrainedHyperparams, num_outputs: int) -> tuple[NetworkLayout, ...]:
    """The networks of one member.

    Args:
        hyperparams: Of the member.
        num_outputs: PPO: what the policy's head gives; DQN: actions.

    Returns:
        PPO: policy and value function, or both in one if they share layers; DQN: the Q-network. Values are the last
        output, of a value function by itself the first.
    """
    value = Part("vf", num_outputs, num_outputs + 1)
    if isinstance(hyperparams, DQNHyperparams):
        heads = [Part("af", 0, num_outputs), *([value] if hyperparams.dueling else [])]
        return (_layout(hyperparams, "encoder", heads),)
    policy = Part("pi", 0, num_outputs)
    if hyperparams.vf_share_layers:
        return (_layout(hyperparams, "encoder.encoder", [policy, value]),)
    return (
        _layout(hyperparams, "encoder.actor_encoder", [policy]),
        _layout(hyperparams, "encoder.critic_encoder", [Part("vf", 0, 1)]),
    )


def _layout(hyperparams: TrainedHyperparams, encoder: str, heads: list[Part]) -> NetworkLayout:
    # Layers with weights stand at every other place, the activations (none if linear) between them.
    step = 1 if hyperparams.activation == "linear" else 2
    hidden = [
        (Part(f"{encoder}.mlp.{number * step}", 0, size),) for number, size in enumerate(hyperparams.hidden_sizes)
    ]
    return NetworkLayout((*hidden, tuple(heads)))


def num_stack_outputs(hyperparams: TrainedHyperparams, num_outputs: int) -> int:
    """Outputs of the networks of a stack: with one more for a value in the same network."""
    if isinstance(hyperparams, PPOHyperparams):
        return num_outputs + hyperparams.vf_share_layers
    return num_outputs + hyperparams.dueling


MAX_GROUP = 8
"""Networks of so many members fit a core's cache with their activations; larger groups are no faster."""


def size_class(num_units: int) -> int:
    """The size up to which a hidden layer is padded: 8, 12, 16, 24, 32, 48, ...; at most a third is waste."""
    size = 8
    while size < num_units:
        size = size * 3 // 2 if size & (size - 1) == 0 else size * 4 // 3
    return size


def group_members(
    members: Sequence[Member[H]], max_size: int = MAX_GROUP, also: Callable[[Member[H]], Any] = lambda _: 0
) -> list[list[Member[H]]]:
    """Members whose networks are computed together: of the same activation and about the same sizes.

    Args:
        members: All of a stack.
        max_size: Of a group.
        also: What else the members of a group have in common; sortable.
    """

    def key(member: Member[H]) -> tuple[str, tuple[int, ...], Any]:
        sizes = tuple(map(size_class, member.hyperparams.hidden_sizes))
        return member.hyperparams.activation, sizes, also(member)

    groups = []
    for _, alike in itertools.groupby(sorted(members, key=key), key=key):
        found = list(alike)
        num_groups = -(-len(found) // max_size)
        bounds = [len(found) * number // num_groups for number in range(num_groups + 1)]
        groups += [found[start:stop] for start, stop in itertools.pairwise(bounds)]
    return groups

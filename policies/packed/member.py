"""The members of a pack, and how an RLModule's weights are laid out in a stack's rows.

Names of weights are those of `policies.networks.rl_modules`' modules, so that a member can be turned into
an RLlib algorithm and back.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from policies.hyperparams import DQNHyperparams, PPOHyperparams, TrainedHyperparams
from policies.packed.convolutions import Convolution
from policies.packed.sizes import group_key
from policies.return_statistics import ReturnStatistics

Weights = dict[str, NDArray[Any]]

OBS_MEAN, OBS_VAR, OBS_COUNT = "obs_mean", "obs_var", "obs_count"
TARGET_PREFIX = "_target_"


H = TypeVar("H", bound=TrainedHyperparams)
H_co = TypeVar("H_co", bound=TrainedHyperparams, covariant=True)


@dataclass(eq=False)
class Member(Generic[H_co]):
    """One trial of a pack: all its state except its running episodes and its replay memory.

    The weights and moments here are those of the last time its stack wrote them back.
    """

    member_id: str
    hyperparams: H_co
    seed: int
    weights: Weights
    """The weights by the RLModule's names, including target networks (`_target_...`) and observation statistics."""
    moments: dict[str, Weights] = field(default_factory=dict)
    """The optimizer's moments by torch's names (`exp_avg`), then by the weights' names; empty before the first step."""
    num_optimizer_steps: int = 0
    num_env_steps: int = 0
    num_episodes: int = 0
    num_iterations: int = 0
    num_updates: int = 0
    kl_coeff: float = 0.0
    """PPO: the present weight of the KL penalty."""
    return_statistics: ReturnStatistics = field(default_factory=ReturnStatistics)
    """PPO with `normalize_rewards`: those of the discounted return so far."""
    due: float = 0.0
    """DQN: the number of updates that are due but not made."""
    target_updates_at: float = 0.0
    """DQN: env steps or episodes at the last target update."""
    num_target_updates: int = 0
    failure_penalty: float | None = None
    """Reward of env steps that end an episode by failure; None: the env's own reward."""
    atari_training: dict[str, bool] | None = None
    """The arguments of the `AtariTraining` that it learns through; None: it learns from games as they are."""
    rng: np.random.Generator = field(kw_only=True)
    """Draws actions, permutations and batches."""


AnyMember = Member[TrainedHyperparams]
"""A member of PPO or DQN."""


@dataclass(frozen=True)
class MemberStats:
    """A member's results of one iteration."""

    num_env_steps: int
    episodes: tuple[tuple[float, int], ...]
    """(undiscounted return, env steps) of each whole episode that ended in it, oldest first."""
    learner: dict[str, float]


@dataclass(frozen=True)
class Part:
    """One layer of the RLModule: some columns of a layer of the stack."""

    name: str
    start: int
    stop: int
    planes: tuple[int, int, int] | None = None
    """(channels, height, width) of a kernel or of the images that a dense layer gets: the order of the RLModule's
    weights, while a stack has channels last. None: inputs are vectors."""
    is_kernel: bool = False
    """Whether it is a convolution."""
    num_beside: int = 0
    """The inputs of a dense layer behind those that are of images."""

    def as_matrix(self, weight: NDArray[Any]) -> NDArray[Any]:
        """Return the RLModule's weight as the stack's matrix, (inputs, outputs)."""
        if self.planes is not None:
            num_outputs = len(weight)
            weight = weight.reshape(num_outputs, -1)
            size = math.prod(self.planes)
            of_images = weight[:, :size].reshape(-1, *self.planes).transpose(0, 2, 3, 1)
            weight = np.concatenate([of_images.reshape(num_outputs, -1), weight[:, size:]], axis=1)
        return np.ascontiguousarray(weight.T)

    def as_weight(self, matrix: NDArray[Any]) -> NDArray[Any]:
        """Return a matrix of the stack as the RLModule's weight; the inverse of `as_matrix`."""
        weight = matrix.T
        if self.planes is not None:
            channels, height, width = self.planes
            of_images = weight[:, : math.prod(self.planes)].reshape(-1, height, width, channels).transpose(0, 3, 1, 2)
            if self.is_kernel:
                return np.array(of_images, order="C")
            beside = weight[:, math.prod(self.planes) :]
            weight = np.concatenate([of_images.reshape(len(weight), -1), beside], axis=1)
        return np.array(weight, order="C")


@dataclass(frozen=True)
class NetworkLayout:
    """The layers of the RLModule that make one network of a stack, from input to output."""

    layers: tuple[tuple[Part, ...], ...]

    def write(self, layers: Sequence[Tensor], weights: Mapping[str, NDArray[Any]], prefix: str = "") -> None:
        """Copy an RLModule's weights into the layers of one row, each of shape (inputs + 1, outputs)."""
        for parts, layer in zip(self.layers, layers, strict=True):
            for part in parts:
                matrix = torch.from_numpy(part.as_matrix(weights[f"{prefix}{part.name}.weight"]))
                layer[: len(matrix), part.start : part.stop] = matrix
                layer[-1, part.start : part.stop] = torch.from_numpy(weights[f"{prefix}{part.name}.bias"])

    def read(self, layers: Sequence[Tensor], num_inputs: int, prefix: str = "") -> Weights:
        """Return an RLModule's weights from the layers of one row; the inverse of `write`."""
        weights: Weights = {}
        for parts, layer in zip(self.layers, layers, strict=True):
            for part in parts:
                columns = layer[:, part.start : part.stop].detach().cpu().numpy()
                num_inputs = num_inputs if part.planes is None else math.prod(part.planes) + part.num_beside
                weights[f"{prefix}{part.name}.weight"] = part.as_weight(columns[:num_inputs])
                weights[f"{prefix}{part.name}.bias"] = np.array(columns[-1])
            num_inputs = parts[-1].stop
        return weights


def network_layouts(
    hyperparams: TrainedHyperparams,
    num_outputs: int,
    convolutions: Sequence[Convolution] = (),
    num_beside: int = 0,
) -> tuple[NetworkLayout, ...]:
    """Return the layouts of one member's networks.

    Args:
        hyperparams: The member's.
        num_outputs: PPO: the number of outputs of the policy's head; DQN: the number of actions.
        convolutions: The sizes of its convolutions.
        num_beside: The numbers of an observation that dense layers get beside what convolutions make of the others.

    Returns:
        PPO: the policy and the value function, or both in one if they share layers; DQN: the Q-network. The value is
        the last output, or the first in a network for the value function only.
    """
    value = Part("vf", num_outputs, num_outputs + 1)

    def layout(encoder: str, heads: list[Part]) -> NetworkLayout:
        return _layout(hyperparams, encoder, heads, convolutions, num_beside)

    if isinstance(hyperparams, DQNHyperparams):
        return (layout("encoder", [Part("af", 0, num_outputs), *([value] if hyperparams.dueling else [])]),)
    policy = Part("pi", 0, num_outputs)
    if hyperparams.vf_share_layers:
        return (layout("encoder.encoder", [policy, value]),)
    return (layout("encoder.actor_encoder", [policy]), layout("encoder.critic_encoder", [Part("vf", 0, 1)]))


def _layout(
    hyperparams: TrainedHyperparams,
    encoder: str,
    heads: list[Part],
    convolutions: Sequence[Convolution],
    num_beside: int,
) -> NetworkLayout:
    # Layers with weights are at every other index, with the activations (none if linear) between them.
    step = 1 if hyperparams.activation == "linear" else 2
    kernels, planes = [], None
    for number, one in enumerate(convolutions):
        kernel = (one.image[2], one.kernel, one.kernel)
        kernels.append((Part(f"{encoder}.conv.{number * step}", 0, one.num_filters, kernel, is_kernel=True),))
        height, width, channels = one.out
        planes = channels, height, width
    hidden = []
    for number, size in enumerate(hyperparams.hidden_sizes):
        name = f"{encoder}.mlp.{number * step}"
        first = Part(name, 0, size, planes, num_beside=num_beside)
        hidden.append((Part(name, 0, size) if number else first,))
    return NetworkLayout((*kernels, *hidden, tuple(heads)))


def num_stack_outputs(hyperparams: TrainedHyperparams, num_outputs: int) -> int:
    """Return the number of outputs of a stack's networks: one more if the network also gives a value."""
    if isinstance(hyperparams, PPOHyperparams):
        return num_outputs + hyperparams.vf_share_layers
    return num_outputs + hyperparams.dueling


MAX_GROUP = 12
"""Up to about this many members an update of small networks becomes cheaper for each; beyond, a core's cache is too
small for what larger ones keep (decision 10)."""


def group_members(
    members: Sequence[Member[H]], max_size: int = MAX_GROUP, also: Callable[[Member[H]], Any] = lambda _: 0
) -> list[list[Member[H]]]:
    """Group the members whose networks are computed together: about the same sizes.

    Members of one activation are neighbours in a group: what they have in common is one call.

    Args:
        members: All members of a stack.
        max_size: The most members of a group.
        also: Returns a sortable value that the members of a group must share as well.
    """

    def key(member: Member[H]) -> tuple[Any, Any]:
        return group_key(member.hyperparams), also(member)

    groups = []
    by_activation = sorted(members, key=lambda member: member.hyperparams.activation)
    for _, alike in itertools.groupby(sorted(by_activation, key=key), key=key):
        found = list(alike)
        num_groups = -(-len(found) // max_size)
        bounds = [len(found) * number // num_groups for number in range(num_groups + 1)]
        groups += [found[start:stop] for start, stop in itertools.pairwise(bounds)]
    return groups

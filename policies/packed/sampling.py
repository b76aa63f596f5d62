"""Track episodes and prepare observations, for the stacks of both PPO and DQN.

Shapes: M members, T vector steps, N sub-environments per member, S = M * N rows, W numbers per observation, the first A
of which are a mask of actions if there is one, D that networks see.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from policies.envs.masks import FORBIDDEN
from policies.networks.layers import OBSERVATION_CLIP, VARIANCE_EPSILON, column_blocks
from policies.packed.inputs import Inputs
from policies.packed.member import OBS_COUNT, OBS_MEAN, OBS_VAR, AnyMember

Floats = NDArray[np.float32]


class EpisodeTracker:
    """Tracks returns and lengths of running episodes, row by row."""

    def __init__(self) -> None:
        self._running: dict[str, tuple[NDArray[np.float64], NDArray[np.int64]]] = {}

    def add(self, member_id: str, num_envs: int) -> None:
        """Begin a member's episodes."""
        self._running[member_id] = (np.zeros(num_envs), np.zeros(num_envs, dtype=np.int64))

    def remove(self, member_id: str) -> None:
        """Forget a member's running episodes."""
        del self._running[member_id]

    def follow(
        self, member_ids: Sequence[str], rewards: Floats, ended: NDArray[np.bool_]
    ) -> list[tuple[tuple[float, int], ...]]:
        """Process some steps.

        Args:
            member_ids: The members in the order of the rows.
            rewards: The env's own rewards, (T, S).
            ended: Whether each step ended its episode, (T, S).

        Returns:
            For each member, the return and the env steps of each episode that ended, oldest first.
        """
        num_steps, num_rows = ended.shape
        num_envs = num_rows // len(member_ids)
        returns = np.concatenate([self._running[name][0] for name in member_ids])
        lengths = np.concatenate([self._running[name][1] for name in member_ids])
        sums = np.cumsum(rewards, axis=0, dtype=np.float64)
        found: list[list[tuple[int, int, float, int]]] = [[] for _ in member_ids]
        # Sorted by row, then by time: an episode begins after the end that is before it in the list.
        rows, steps = np.nonzero(ended.T)
        start_sum, start_step = np.zeros(num_rows), np.zeros(num_rows, dtype=np.int64)
        for row, step in zip(rows.tolist(), steps.tolist(), strict=True):
            total = float(returns[row] + sums[step, row] - start_sum[row])
            length = int(lengths[row] + step + 1 - start_step[row])
            found[row // num_envs].append((step, row, total, length))
            returns[row], lengths[row] = 0.0, 0
            start_sum[row], start_step[row] = sums[step, row], step + 1
        returns += sums[-1] - start_sum
        lengths += num_steps - start_step
        for index, name in enumerate(member_ids):
            own = slice(index * num_envs, (index + 1) * num_envs)
            self._running[name] = (returns[own], lengths[own])
        return [tuple((total, length) for _, _, total, length in sorted(items)) for items in found]


class Observations:
    """Prepares observations for the networks: bytes scaled, all normalised by each member's own statistics if asked to.

    Args:
        members: The members in the order of the rows.
        num_envs: Sub-environments per member, N.
        normalizes: Whether observations are normalised.
        seen: What networks see of observations, of which A numbers are a mask.
    """

    def __init__(self, members: Sequence[AnyMember], num_envs: int, *, normalizes: bool, seen: Inputs) -> None:
        self._members, self._num_envs, self._normalizes = members, num_envs, normalizes
        self._seen, self._num_masked = seen, seen.num_masked
        if normalizes:
            self._refresh()

    def _refresh(self) -> None:
        self._mean = np.stack([member.weights[OBS_MEAN].reshape(-1) for member in self._members])[:, None]
        variance = np.stack([member.weights[OBS_VAR].reshape(-1) for member in self._members])[:, None]
        self._factor = (1.0 / np.sqrt(variance + np.float32(VARIANCE_EPSILON))).astype(np.float32)

    def prepare(self, observations: NDArray[Any]) -> Floats:
        """Return what networks see of observations: (S, W) as (M, N, D), or (T, S, W) as (T, M, N, D)."""
        if self._num_masked:
            # In one piece of memory, as other sums may be rounded otherwise.
            observations = np.ascontiguousarray(observations[..., self._num_masked :])
        num_members = len(self._members)
        x: Floats = observations.reshape(*observations.shape[:-2], num_members, -1, observations.shape[-1])
        if self._seen.is_bytes or self._seen.scale != 1.0:
            x = x.astype(np.float32)
            x *= np.float32(self._seen.scale)
        if not self._normalizes:
            return x
        scaled: Floats = (x - self._mean) * self._factor
        np.clip(scaled, -OBSERVATION_CLIP, OBSERVATION_CLIP, out=scaled)
        return scaled

    def prepare_bytes(self, images: Tensor) -> Tensor:
        """Return what networks see of images of bytes, (M, B, D)."""
        x = images.float()
        x *= self._seen.scale
        if self._normalizes:
            mean, factor = (torch.from_numpy(part).to(x.device) for part in (self._mean, self._factor))
            x = ((x - mean) * factor).clamp_(-OBSERVATION_CLIP, OBSERVATION_CLIP)
        return x

    def prepare_columns(self, columns: Floats) -> None:
        """Prepare observations in columns, (M, B, W or more), in place; those of bytes are prepared as tensors."""
        columns = columns[..., self._num_masked : self._num_masked + self._seen.num_inputs]
        if self._seen.scale != 1.0:
            columns *= np.float32(self._seen.scale)
        if self._normalizes:
            columns -= self._mean
            columns *= self._factor
            np.clip(columns, -OBSERVATION_CLIP, OBSERVATION_CLIP, out=columns)

    def part(self, start: int, stop: int) -> Observations:
        """Return the same for only the members from start to stop."""
        return Observations(self._members[start:stop], self._num_envs, normalizes=self._normalizes, seen=self._seen)

    def learn(self, observations: NDArray[Any]) -> None:
        """Add observations as the env returned them, (T, S, W), to each member's statistics."""
        if not self._normalizes:
            return
        observations = observations[..., self._num_masked :]
        rows = observations.reshape(len(observations), len(self._members), -1, observations.shape[-1])
        for index, member in enumerate(self._members):
            merge_statistics(member, rows[:, index].reshape(-1, observations.shape[-1]), self._seen.scale)
        self._refresh()


def merge_statistics(member: AnyMember, rows: NDArray[Any], scale: float = 1.0) -> None:
    """Add observations, (B, D), times a scale to a member's statistics, as `ObservationStatistics` does."""
    weights: dict[str, Any] = member.weights
    count, num_new = int(weights[OBS_COUNT]), len(rows)
    mean, deviations = np.empty(rows.shape[1]), np.empty(rows.shape[1])
    for part in column_blocks(rows.shape[1]):
        block = rows[:, part].astype(np.float64)
        if scale != 1.0:
            block *= scale
        own = np.add.reduce(block, axis=0, out=mean[part])
        own /= num_new
        block -= own
        np.add.reduce(np.square(block, out=block), axis=0, out=deviations[part])
    mean, deviations = (numbers.reshape(weights[OBS_MEAN].shape) for numbers in (mean, deviations))
    total = count + num_new
    delta = mean - weights[OBS_MEAN]
    squares = weights[OBS_VAR].astype(np.float64) * count + deviations
    squares += delta**2 * (count * num_new / total)
    weights[OBS_MEAN] = (weights[OBS_MEAN] + delta * (num_new / total)).astype(np.float32)
    weights[OBS_VAR] = (squares / total).astype(np.float32)
    weights[OBS_COUNT] = np.array(total, dtype=np.int64)


def mask_outputs(outputs: Floats, observations: NDArray[Any], num_masked: int) -> None:
    """Write `FORBIDDEN` over outputs, (..., A), where the masks of observations, (..., W), forbid the action.

    The others are finite afterwards, in place of the NaN and the infinity of a member whose weights are ruined: what is
    chosen by comparing outputs may be forbidden otherwise.
    """
    np.copyto(outputs, np.float32(0.0), where=~np.isfinite(outputs))
    np.copyto(outputs, np.float32(FORBIDDEN), where=observations[..., :num_masked] == 0)


def allowed_at(numbers: NDArray[np.float64], observations: NDArray[Any], num_masked: int) -> NDArray[np.int64]:
    """Return an action that is allowed for each uniform number in [0, 1), (...), each of them equally likely."""
    counts = np.cumsum(observations[..., :num_masked] > 0, axis=-1)
    chosen = np.minimum((numbers * counts[..., -1]).astype(np.int64), counts[..., -1] - 1)
    return np.asarray((counts > chosen[..., None]).argmax(axis=-1), dtype=np.int64)


def one_hot(actions: NDArray[np.int64], num_actions: int) -> Floats:
    """Return whole numbers, (...), in one-hot form, (..., num_actions)."""
    out: Floats = (actions[..., None] == np.arange(num_actions)).astype(np.float32)
    return out

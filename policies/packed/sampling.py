"""What the stacks of PPO and DQN share: members, their rows of environments, their episodes and observations.

Shapes: M members, T vector steps, N sub-environments a member, S = M * N rows, D numbers an observation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from policies.networks.layers import OBSERVATION_CLIP, VARIANCE_EPSILON
from policies.packed.member import OBS_COUNT, OBS_MEAN, OBS_VAR, AnyMember

Floats = NDArray[np.float32]


class EpisodeTracker:
    """Returns and lengths of running episodes, row by row."""

    def __init__(self) -> None:
        self._running: dict[str, tuple[NDArray[np.float64], NDArray[np.int64]]] = {}

    def add(self, member_id: str, num_envs: int) -> None:
        """A member's episodes begin."""
        self._running[member_id] = (np.zeros(num_envs), np.zeros(num_envs, dtype=np.int64))

    def remove(self, member_id: str) -> None:
        """Its episodes will not end."""
        del self._running[member_id]

    def follow(
        self, member_ids: Sequence[str], rewards: Floats, ended: NDArray[np.bool_]
    ) -> list[tuple[tuple[float, int], ...]]:
        """Take in a stretch of steps.

        Args:
            member_ids: In the order of the rows.
            rewards: The env's own, (T, S).
            ended: (T, S).

        Returns:
            For each member (return, env steps) of the episodes that ended, oldest first.
        """
        num_steps, num_rows = ended.shape
        num_envs = num_rows // len(member_ids)
        returns = np.concatenate([self._running[name][0] for name in member_ids])
        lengths = np.concatenate([self._running[name][1] for name in member_ids])
        sums = np.cumsum(rewards, axis=0, dtype=np.float64)
        found: list[list[tuple[int, int, float, int]]] = [[] for _ in member_ids]
        # By row, then by time, so that an episode's beginning is the end before it in the list.
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
    """What the networks see of observations: normalised by each member's own statistics, or as they are.

    Args:
        members: In the order of the rows.
        num_envs: N.
        normalizes: Whether observations are normalised.
    """

    def __init__(self, members: Sequence[AnyMember], num_envs: int, *, normalizes: bool) -> None:
        self._members, self._num_envs, self._normalizes = members, num_envs, normalizes
        if normalizes:
            self._refresh()

    def _refresh(self) -> None:
        self._mean = np.stack([member.weights[OBS_MEAN] for member in self._members])[:, None]
        variance = np.stack([member.weights[OBS_VAR] for member in self._members])[:, None]
        self._factor = (1.0 / np.sqrt(variance + np.float32(VARIANCE_EPSILON))).astype(np.float32)

    def prepare(self, observations: Floats) -> Floats:
        """(S, D), or (T, S, D), as (M, N, D) or (T, M, N, D)."""
        num_members = len(self._members)
        x: Floats = observations.reshape(*observations.shape[:-2], num_members, -1, observations.shape[-1])
        if not self._normalizes:
            return x
        scaled: Floats = (x - self._mean) * self._factor
        np.clip(scaled, -OBSERVATION_CLIP, OBSERVATION_CLIP, out=scaled)
        return scaled

    def prepare_rows(self, rows: Floats, num_inputs: int) -> Floats:
        """Rows of a replay memory, (M, B, columns), with their observations prepared in place."""
        if self._normalizes:
            for first in (0, num_inputs + 1):
                columns = rows[..., first : first + num_inputs]
                columns -= self._mean
                columns *= self._factor
                np.clip(columns, -OBSERVATION_CLIP, OBSERVATION_CLIP, out=columns)
        return rows

    def part(self, start: int, stop: int) -> Observations:
        """Of the members start to stop alone."""
        return Observations(self._members[start:stop], self._num_envs, normalizes=self._normalizes)

    def learn(self, observations: Floats) -> None:
        """Add observations as the env gave them, (T, S, D), to each member's statistics."""
        if not self._normalizes:
            return
        rows = observations.reshape(len(observations), len(self._members), -1, observations.shape[-1])
        for index, member in enumerate(self._members):
            merge_statistics(member, rows[:, index].reshape(-1, observations.shape[-1]))
        self._refresh()


def merge_statistics(member: AnyMember, rows: Floats) -> None:
    """Add observations, (B, D), to a member's statistics, as `ObservationStatistics` does."""
    weights: dict[str, Any] = member.weights
    count, num_new = int(weights[OBS_COUNT]), len(rows)
    batch = rows.astype(np.float64)
    mean = batch.mean(axis=0)
    total = count + num_new
    delta = mean - weights[OBS_MEAN]
    squares = weights[OBS_VAR].astype(np.float64) * count + ((batch - mean) ** 2).sum(axis=0)
    squares += delta**2 * (count * num_new / total)
    weights[OBS_MEAN] = (weights[OBS_MEAN] + delta * (num_new / total)).astype(np.float32)
    weights[OBS_VAR] = (squares / total).astype(np.float32)
    weights[OBS_COUNT] = np.array(total, dtype=np.int64)


def one_hot(actions: NDArray[np.int64], num_actions: int) -> Floats:
    """Actions, (...), as (..., num_actions)."""
    out: Floats = (actions[..., None] == np.arange(num_actions)).astype(np.float32)
    return out

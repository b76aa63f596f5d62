"""Replay memories for DQN, held in arrays: uniform, prioritized, or none at all.

Words: a *transition* is (observation, action, reward, next observation, discount); its reward is the discounted sum of
the rewards of n steps, and its *discount* is the factor of the next observation's value: gamma^n, or 0 where the
episode terminated. A truncated episode is bootstrapped. Array shapes: T vector steps, N sub-environments, B rows.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from policies import random_streams
from policies.hyperparams import DQNHyperparams
from policies.sum_trees import SumTrees

_MAX_GATHER_BYTES = 64 * 2**20

Columns = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Transitions:
    """Columns of transitions, shape (B, ...) or, for several batches at once, (batches, B, ...)."""

    obs: NDArray[Any]
    actions: NDArray[np.int64]
    rewards: NDArray[np.float32]
    next_obs: NDArray[Any]
    discounts: NDArray[np.float32]
    weights: NDArray[np.float32] | None = None
    """Importance weights; None: all 1."""
    indices: NDArray[np.int64] | None = None
    """The indices of prioritized rows, by which their priorities are set."""


class NStep:
    """Turns steps of N sub-environments into n-step transitions, across the ends of fragments.

    The last steps of an episode have fewer rewards, and their discount is larger accordingly.

    Args:
        num_envs: The number of sub-environments, N.
        n_step: Steps of reward before bootstrapping.
        gamma: Discount factor per step.
    """

    def __init__(self, num_envs: int, n_step: int, gamma: float) -> None:
        self._n_step, self._gamma = n_step, gamma
        self._pending: list[deque[list[Any]]] = [deque() for _ in range(num_envs)]

    def forget(self) -> None:
        """Drop the transitions that wait for rewards, because the episodes begin anew."""
        for pending in self._pending:
            pending.clear()

    def transitions(self, columns: Columns) -> Transitions:
        """Return the transitions that are complete after these steps, oldest first; there may be none.

        Args:
            columns: T steps of N sub-environments: obs has the shape (T + 1, N, ...), the others have (T, N).
        """
        if self._n_step == 1:
            mask = columns["stepped"]
            return Transitions(
                obs=columns["obs"][:-1][mask],
                actions=columns["actions"][mask].astype(np.int64),
                rewards=columns["rewards"][mask].astype(np.float32),
                next_obs=columns["obs"][1:][mask],
                discounts=np.where(columns["terminated"][mask], 0.0, self._gamma).astype(np.float32),
            )
        rows = [row for step in range(len(columns["stepped"])) for row in self._step(columns, step)]
        obs = columns["obs"]
        return Transitions(
            obs=np.array([row[0] for row in rows], dtype=obs.dtype).reshape(-1, *obs.shape[2:]),
            actions=np.array([row[1] for row in rows], dtype=np.int64),
            rewards=np.array([row[2] for row in rows], dtype=np.float32),
            next_obs=np.array([row[4] for row in rows], dtype=obs.dtype).reshape(-1, *obs.shape[2:]),
            discounts=np.array([row[5] for row in rows], dtype=np.float32),
        )

    def _step(self, columns: Columns, step: int) -> Iterator[tuple[Any, ...]]:
        for index in np.flatnonzero(columns["stepped"][step]):
            pending = self._pending[index]
            reward, terminated = float(columns["rewards"][step, index]), bool(columns["terminated"][step, index])
            for row in pending:
                row[2] += self._gamma ** row[3] * reward
                row[3] += 1
            pending.append([columns["obs"][step, index], columns["actions"][step, index], reward, 1])
            ended = terminated or bool(columns["truncated"][step, index])
            while pending and (ended or len(pending) == self._n_step):
                row = pending.popleft()
                discount = 0.0 if terminated else self._gamma ** row[3]
                yield (*row, columns["obs"][step + 1, index], discount)


class ReplayBuffer:
    """A ring of transitions, from which batches are drawn uniformly and with replacement.

    Args:
        capacity: The most transitions it holds; the oldest are dropped first.
        rng: Draws the batches.
    """

    def __init__(self, capacity: int, rng: np.random.Generator) -> None:
        self.capacity = capacity
        self.rng = rng
        self._columns: dict[str, NDArray[Any]] = {}
        self._next = 0
        self._size = 0

    def __len__(self) -> int:
        """Return the number of transitions."""
        return self._size

    def expect(self, num_transitions: int) -> None:
        """Take no more room than for so many transitions, as more will never come; told before the first are added."""
        self.capacity = min(self.capacity, num_transitions)

    def add(self, transitions: Transitions) -> NDArray[np.int64]:
        """Append transitions, shape (B, ...); if more are given than fit, the newest stay.

        Returns:
            The indices at which they were stored.
        """
        rows = {name: getattr(transitions, name) for name in ("obs", "actions", "rewards", "next_obs", "discounts")}
        if not self._columns:
            self._columns = {
                name: np.empty((self.capacity, *values.shape[1:]), values.dtype) for name, values in rows.items()
            }
        num_rows = min(len(rows["actions"]), self.capacity)
        where = (self._next + np.arange(num_rows)) % self.capacity
        for name, values in rows.items():
            self._columns[name][where] = values[len(values) - num_rows :]
        self._next = (self._next + num_rows) % self.capacity
        self._size = min(self.capacity, self._size + num_rows)
        return where

    def batches(self, num_batches: int, batch_size: int) -> Iterator[Transitions]:
        """Draw batches of shape (B, ...), one after another."""
        if not self._size or not num_batches:
            return
        row_bytes = 2 * self._columns["obs"][0].nbytes + 24
        # Many batches are gathered at once, because indexing costs more than copying the rows of a small batch.
        at_once = max(1, min(num_batches, _MAX_GATHER_BYTES // (row_bytes * batch_size)))
        for first in range(0, num_batches, at_once):
            shape = (min(at_once, num_batches - first), batch_size)
            indices = self.rng.integers(0, self._size, shape)
            drawn = {name: values[indices] for name, values in self._columns.items()}
            for number in range(shape[0]):
                yield Transitions(**{name: values[number] for name, values in drawn.items()})

    def set_priorities(self, indices: NDArray[np.int64], td_errors: NDArray[np.float32]) -> None:
        """Do nothing, because all rows are equally likely."""


class LastTransitions(ReplayBuffer):
    """A memory without replay: every batch is the newest transitions, in order."""

    def batches(self, num_batches: int, batch_size: int) -> Iterator[Transitions]:
        """Yield the newest transitions each time; fewer than asked for while there are fewer."""
        if not self._size:
            return
        batch_size = min(batch_size, self._size)
        where = (self._next - batch_size + np.arange(batch_size)) % self.capacity
        for _ in range(num_batches):
            yield Transitions(**{name: values[where] for name, values in self._columns.items()})


class PrioritizedReplayBuffer(ReplayBuffer):
    """A ring of transitions, from which batches are drawn in proportion to (|TD error| + epsilon)^alpha.

    Source: Schaul et al. 2016, "Prioritized Experience Replay", section 3.3 (proportional variant).

    Args:
        capacity: The most transitions it holds; the oldest are dropped first.
        rng: Draws the batches.
        alpha: Exponent of the priorities.
        beta: Exponent of the importance weights, which are divided by the batch's largest.
        epsilon: What is added to each |TD error|.
    """

    def __init__(
        self, capacity: int, rng: np.random.Generator, *, alpha: float, beta: float, epsilon: float = 1e-6
    ) -> None:
        super().__init__(capacity, rng)
        self.alpha, self.beta, self.epsilon = alpha, beta, epsilon
        # One tree, whose leaves are the rows.
        self._priorities = SumTrees(1, capacity)
        self._highest = 1.0

    def add(self, transitions: Transitions) -> NDArray[np.int64]:
        """Append transitions; they get the highest priority so far, so that each is soon drawn."""
        where = super().add(transitions)
        self._priorities.set(where, np.full(len(where), self._highest))
        return where

    def batches(self, num_batches: int, batch_size: int) -> Iterator[Transitions]:
        """Draw batches; priorities that are set between two of them affect the next."""
        if not self._size:
            return
        root = np.zeros(batch_size, dtype=np.int64)
        for _ in range(num_batches):
            total = self._priorities.totals[0]
            leaves = self._priorities.find(root, self.rng.uniform(0.0, total, batch_size))
            indices = np.minimum(leaves, self._size - 1)
            shares = self._priorities.leaves[indices] / total
            weights = (self._size * shares) ** -self.beta
            rows = {name: values[indices] for name, values in self._columns.items()}
            weights = (weights / weights.max()).astype(np.float32)
            yield Transitions(**rows, weights=weights, indices=indices)

    def set_priorities(self, indices: NDArray[np.int64], td_errors: NDArray[np.float32]) -> None:
        """Set the priorities of rows from their newest TD errors."""
        priorities = (np.abs(td_errors).astype(np.float64) + self.epsilon) ** self.alpha
        priorities = np.where(np.isfinite(priorities), priorities, self._highest)
        self._highest = float(priorities.max(initial=self._highest))
        self._priorities.set(indices, priorities)


def make_replay(hyperparams: DQNHyperparams, seed: int) -> ReplayBuffer:
    """Return the replay memory that the hyperparameters name."""
    rng = random_streams.seeded(seed)
    if hyperparams.replay == "none":
        return LastTransitions(hyperparams.train_batch_size, rng)
    if hyperparams.replay == "prioritized":
        return PrioritizedReplayBuffer(
            hyperparams.replay_capacity,
            rng,
            alpha=hyperparams.prioritized_alpha,
            beta=hyperparams.prioritized_beta,
            epsilon=hyperparams.prioritized_epsilon,
        )
    return ReplayBuffer(hyperparams.replay_capacity, rng)

"""Replay memories of many members in one array, so that one gather serves them all.

The same memories as `policies.replay`'s, whose words hold here too. Shapes: M members (of a call), K new transitions,
B rows a batch, D numbers an observation. A member's rows are its *slot*, which it keeps until it leaves.

Columns of a row: observation, 1, next observation, 1, action, reward, discount; the ones are for the first bias of
`StackedNetworks`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from policies.hyperparams import DQNHyperparams
from policies.packed.shared import SharedByDQN

_MIN_PRIORITY = 1e-6

Floats = NDArray[np.float32]
Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Drawn:
    """A batch of each of M members."""

    rows: Floats
    """(M, B, columns)."""
    weights: Floats | None = None
    """Importance weights, (M, B); None: all 1."""
    indices: Indices | None = None
    """Where the rows lie in the members' slots, (M, B), to set their priorities."""


class StackedReplay:
    """Rings of transitions, drawn from uniformly and with replacement, or the newest alone.

    Args:
        shared: By all members.
        num_inputs: D.
    """

    def __init__(self, shared: SharedByDQN, num_inputs: int) -> None:
        self._newest_only = shared.replay == "none"
        self.num_columns = 2 * num_inputs + 5
        self._num_inputs = num_inputs
        self._rows: Floats = np.empty((0, 0, self.num_columns), dtype=np.float32)
        self._slots: dict[str, int] = {}
        self._capacity: Indices = np.zeros(0, dtype=np.int64)
        self._next: Indices = np.zeros(0, dtype=np.int64)
        self._size: Indices = np.zeros(0, dtype=np.int64)

    def add_member(self, member_id: str, hyperparams: DQNHyperparams) -> None:
        """Make room for a member's transitions."""
        capacity = hyperparams.train_batch_size if self._newest_only else hyperparams.replay_capacity
        slot = min(set(range(len(self._slots) + 1)) - set(self._slots.values()))
        self._grow(slot + 1, capacity)
        self._slots[member_id] = slot
        self._capacity[slot], self._next[slot], self._size[slot] = capacity, 0, 0

    def _grow(self, num_slots: int, capacity: int) -> None:
        num_now, capacity_now = self._rows.shape[:2]
        if num_slots <= num_now and capacity <= capacity_now:
            return
        # Never touched where nothing is written: the memory is the operating system's until then.
        larger = np.empty((max(num_slots, num_now), max(capacity, capacity_now), self.num_columns), dtype=np.float32)
        for slot in self._slots.values():
            larger[slot, : self._size[slot]] = self._rows[slot, : self._size[slot]]
        self._rows = larger
        for name in ("_capacity", "_next", "_size"):
            values = np.zeros(len(larger), dtype=np.int64)
            values[:num_now] = getattr(self, name)
            setattr(self, name, values)

    def remove_member(self, member_id: str) -> None:
        """Forget a member's transitions."""
        del self._slots[member_id]

    def slots(self, member_ids: Sequence[str]) -> Indices:
        """Where members lie, (M,)."""
        return np.array([self._slots[name] for name in member_ids], dtype=np.int64)

    def sizes(self, slots: Indices) -> Indices:
        """Transitions of each, (M,)."""
        return self._size[slots]

    def add(self, slots: Indices, rows: Floats) -> None:
        """Append as many rows to each of some slots; of more than fit, the newest stay.

        Args:
            slots: (M,).
            rows: (M, K, columns), oldest first.
        """
        num_new = rows.shape[1]
        places = (self._next[slots, None] + np.arange(num_new)) % self._capacity[slots, None]
        smallest = int(self._capacity[slots].min())
        if num_new > smallest:
            for slot, new in zip(slots.tolist(), rows, strict=True):
                self._add_one(slot, new)
            return
        self._rows[slots[:, None], places] = rows
        self._advance(slots, places)

    def _add_one(self, slot: int, rows: Floats) -> None:
        capacity = int(self._capacity[slot])
        rows = rows[max(0, len(rows) - capacity) :]
        places = (self._next[slot] + np.arange(len(rows))) % capacity
        self._rows[slot, places] = rows
        self._advance(np.array([slot]), places[None])

    def _advance(self, slots: Indices, places: Indices) -> None:
        num_new = places.shape[1]
        self._next[slots] = (self._next[slots] + num_new) % self._capacity[slots]
        self._size[slots] = np.minimum(self._capacity[slots], self._size[slots] + num_new)

    def draw(self, slots: Indices, numbers: NDArray[np.float64]) -> Drawn:
        """A batch of each of some members.

        Args:
            slots: (M,).
            numbers: Uniform in [0, 1), (M, B); not looked at where the newest are taken.
        """
        if self._newest_only:
            places = (self._next[slots, None] - numbers.shape[1] + np.arange(numbers.shape[1])) % self._capacity[
                slots, None
            ]
        else:
            places = (numbers * self._size[slots, None]).astype(np.int64)
        return Drawn(self._gather(slots, places))

    def _gather(self, slots: Indices, places: Indices) -> Floats:
        flat = self._rows.reshape(-1, self.num_columns)
        indices = places + slots[:, None] * self._rows.shape[1]
        rows: Floats = flat.take(indices.reshape(-1), axis=0).reshape(*places.shape, self.num_columns)
        return rows

    def set_priorities(self, slots: Indices, indices: Indices, td_errors: Floats) -> None:
        """Nothing: all rows are alike."""


class StackedPrioritizedReplay(StackedReplay):
    """Drawn from in proportion to |TD error|^alpha; see `policies.replay.PrioritizedReplayBuffer`."""

    def __init__(self, shared: SharedByDQN, num_inputs: int) -> None:
        super().__init__(shared, num_inputs)
        # A binary tree for each slot: node i has children 2i and 2i + 1, the leaves are the rows, sums above.
        self._num_leaves = 2
        self._sums: NDArray[np.float64] = np.zeros((0, 4))
        self._highest: NDArray[np.float64] = np.zeros(0)
        self._alpha: NDArray[np.float64] = np.zeros(0)
        self._beta: NDArray[np.float64] = np.zeros(0)

    def add_member(self, member_id: str, hyperparams: DQNHyperparams) -> None:
        """See `StackedReplay.add_member`."""
        super().add_member(member_id, hyperparams)
        self._grow_trees()
        slot = self._slots[member_id]
        self._sums[slot], self._highest[slot] = 0.0, 1.0
        self._alpha[slot], self._beta[slot] = hyperparams.prioritized_alpha, hyperparams.prioritized_beta

    @property
    def _num_levels(self) -> int:
        """Of a tree, above its leaves."""
        return self._num_leaves.bit_length() - 1

    def _grow_trees(self) -> None:
        num_slots, capacity = self._rows.shape[:2]
        num_leaves = 1 << max(1, (capacity - 1).bit_length())
        if num_leaves == self._num_leaves and num_slots == len(self._sums):
            return
        old, self._sums = self._sums[:, self._num_leaves :], np.zeros((num_slots, 2 * num_leaves))
        for name in ("_highest", "_alpha", "_beta"):
            values = np.zeros(num_slots)
            values[: len(old)] = getattr(self, name)
            setattr(self, name, values)
        self._num_leaves = num_leaves
        self._sums[: len(old), num_leaves : num_leaves + old.shape[1]] = old
        for level in range(num_leaves.bit_length() - 2, -1, -1):
            nodes = np.arange(1 << level, 2 << level)
            self._sums[:, nodes] = self._sums[:, 2 * nodes] + self._sums[:, 2 * nodes + 1]

    def _advance(self, slots: Indices, places: Indices) -> None:
        super()._advance(slots, places)
        self._set(slots, places, np.broadcast_to(self._highest[slots, None], places.shape))

    def draw(self, slots: Indices, numbers: NDArray[np.float64]) -> Drawn:
        """See `StackedReplay.draw`; the priorities set between two draws act on the next."""
        totals = self._sums[slots, 1][:, None]
        places = self._find(slots, numbers * totals)
        shares = self._sums[slots[:, None], self._num_leaves + places] / totals
        weights = (self._size[slots, None] * shares) ** -self._beta[slots, None]
        weights = (weights / weights.max(axis=1, keepdims=True)).astype(np.float32)
        return Drawn(self._gather(slots, places), weights, places)

    def set_priorities(self, slots: Indices, indices: Indices, td_errors: Floats) -> None:
        """Set the priorities of rows, (M, B), from their newest TD errors."""
        priorities = (np.abs(td_errors).astype(np.float64) + _MIN_PRIORITY) ** self._alpha[slots, None]
        priorities = np.where(np.isfinite(priorities), priorities, self._highest[slots, None])
        self._highest[slots] = np.maximum(self._highest[slots], priorities.max(axis=1, initial=0.0))
        self._set(slots, indices, priorities)

    def _set(self, slots: Indices, places: Indices, priorities: NDArray[np.float64]) -> None:
        flat = self._sums.reshape(-1)
        first = (slots * 2 * self._num_leaves)[:, None]
        nodes = self._num_leaves + places
        flat[first + nodes] = priorities
        # Level by level, of which there are as many whatever the rows are, and if there are none.
        for _ in range(self._num_levels):
            nodes = nodes >> 1
            flat[first + nodes] = flat[first + 2 * nodes] + flat[first + 2 * nodes + 1]

    def _find(self, slots: Indices, heights: NDArray[np.float64]) -> Indices:
        """The rows at these heights of the stack of all priorities, (M, B)."""
        flat = self._sums.reshape(-1)
        first = (slots * 2 * self._num_leaves)[:, None]
        nodes = np.ones(heights.shape, dtype=np.int64)
        for _ in range(self._num_levels):
            left = 2 * nodes
            sums = flat[first + left]
            beyond = heights >= sums
            heights = np.where(beyond, heights - sums, heights)
            nodes = left + beyond
        # Rounding may lead one step beyond the last row.
        return np.minimum(nodes - self._num_leaves, self._size[slots, None] - 1)


def make_stacked_replay(shared: SharedByDQN, num_inputs: int) -> StackedReplay:
    """The memories that the hyperparameters name, without members."""
    if shared.replay == "prioritized":
        return StackedPrioritizedReplay(shared, num_inputs)
    return StackedReplay(shared, num_inputs)

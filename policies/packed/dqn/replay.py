"""Replay memories of many members in one array, so that one gather serves them all.

They are the memories of `policies.replay`, where the words are explained. Shapes: M members (of a call), K new
transitions, B rows per batch, D numbers per observation. A member has a *slot*, which it keeps until it leaves, and in
it as many neighbouring rows as its own memory holds, whose numbers are the *places* of its transitions.

Columns of a row: observation, next observation, each as `policies.packed.inputs.Inputs` puts it into columns (with a 1
after it, or four bytes of an image in each), then action, reward, discount.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from policies.hyperparams import DQNHyperparams
from policies.packed.inputs import Inputs
from policies.packed.shared import SharedByDQN
from policies.sum_trees import SumTrees

Floats = NDArray[np.float32]
Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Drawn:
    """A batch for each of M members, or U of them."""

    rows: Floats
    """The transitions, (M, B, columns) or (U, M, B, columns)."""
    weights: Floats | None = None
    """Importance weights, (M, B); None: all 1."""
    indices: Indices | None = None
    """The rows' indices in the members' slots, (M, B), by which their priorities are set."""


class StackedReplay:
    """Rings of transitions; batches are drawn uniformly and with replacement, or are the newest transitions.

    Args:
        shared: The hyperparameters that all members share.
        seen: What networks see of an observation.
    """

    draws_ahead = True
    """Whether what is drawn has no part in what the updates before it do, so that U batches may be drawn at once."""

    def __init__(self, shared: SharedByDQN, seen: Inputs) -> None:
        self._newest_only = shared.replay == "none"
        self.num_columns = 2 * seen.num_columns + 3
        self._rows: Floats = np.empty((0, self.num_columns), dtype=np.float32)
        self._slots: dict[str, int] = {}
        # The first row of each slot.
        self._start: Indices = np.zeros(0, dtype=np.int64)
        self._capacity: Indices = np.zeros(0, dtype=np.int64)
        self._next: Indices = np.zeros(0, dtype=np.int64)
        self._size: Indices = np.zeros(0, dtype=np.int64)

    def add_member(self, member_id: str, hyperparams: DQNHyperparams, most: int | None = None) -> None:
        """Make room for a member's transitions, as many as its own memory holds.

        Args:
            member_id: The member.
            hyperparams: Its own.
            most: The most transitions that it will ever have; None: not known.
        """
        slot, capacity = self._free_slot(), self._capacity_of(hyperparams, most)
        start = self._free_rows(capacity)
        if slot == len(self._start):
            for name in ("_start", "_capacity", "_next", "_size"):
                setattr(self, name, np.append(getattr(self, name), 0))
        self._slots[member_id] = slot
        self._start[slot], self._capacity[slot], self._next[slot], self._size[slot] = start, capacity, 0, 0

    def _capacity_of(self, hyperparams: DQNHyperparams, most: int | None) -> int:
        if self._newest_only:
            return hyperparams.train_batch_size
        return hyperparams.replay_capacity if most is None else min(hyperparams.replay_capacity, most)

    def _free_slot(self) -> int:
        return min(set(range(len(self._slots) + 1)) - set(self._slots.values()))

    def _free_rows(self, capacity: int) -> int:
        """Return the first of so many neighbouring rows that are no member's; make room for them if there are none."""
        slots = sorted(self._slots.values(), key=lambda slot: int(self._start[slot]))
        end = 0
        for slot in slots:
            if self._start[slot] - end >= capacity:
                return end
            end = int(self._start[slot] + self._capacity[slot])
        if len(self._rows) - end >= capacity:
            return end
        taken = int(self._capacity[slots].sum())
        rows = self._rows
        if len(rows) < taken + capacity:
            # Left uninitialised: the operating system provides memory only for the rows that are written.
            rows = np.empty((taken + capacity, self.num_columns), dtype=np.float32)
        self._move(slots, rows)
        return taken

    def _move(self, slots: Sequence[int], rows: Floats) -> None:
        """Move members' rows to the beginning of an array, which may be the one that they are in, one after another.

        Args:
            slots: The slots of all members, in the order of their rows.
            rows: The array.
        """
        start = 0
        for slot in slots:
            # As one line of numbers, of which no copy is made first where they move within the array.
            written = self.written(slot).reshape(-1)
            rows.reshape(-1)[start * self.num_columns :][: len(written)] = written
            self._start[slot] = start
            start += int(self._capacity[slot])
        self._rows = rows

    def remove_member(self, member_id: str) -> None:
        """Forget a member's transitions."""
        del self._slots[member_id]

    def slots(self, member_ids: Sequence[str]) -> Indices:
        """Return the members' slots, (M,)."""
        return np.array([self._slots[name] for name in member_ids], dtype=np.int64)

    def sizes(self, slots: Indices) -> Indices:
        """Return the number of transitions in each slot, (M,)."""
        return self._size[slots]

    def written(self, slot: int) -> Floats:
        """Return the transitions in a slot, (size, columns), in the order of their places."""
        start = int(self._start[slot])
        return self._rows[start : start + int(self._size[slot])]

    def add(self, slots: Indices, rows: Floats) -> None:
        """Append K rows to each of some slots; if more are given than fit, the newest stay.

        Args:
            slots: The slots, (M,).
            rows: The new rows, (M, K, columns), oldest first.
        """
        num_new = rows.shape[1]
        capacity = self._capacity.take(slots)
        places = (self._next.take(slots)[:, None] + np.arange(num_new)) % capacity[:, None]
        if num_new > int(capacity.min()):
            for slot, new in zip(slots.tolist(), rows, strict=True):
                self._add_one(slot, new)
            return
        self._rows[self._start.take(slots)[:, None] + places] = rows
        self._advance(slots, places)

    def _add_one(self, slot: int, rows: Floats) -> None:
        capacity = int(self._capacity[slot])
        rows = rows[max(0, len(rows) - capacity) :]
        places = (self._next[slot] + np.arange(len(rows))) % capacity
        self._rows[self._start[slot] + places] = rows
        self._advance(np.array([slot]), places[None])

    def _advance(self, slots: Indices, places: Indices) -> None:
        num_new = places.shape[1]
        self._next[slots] = (self._next[slots] + num_new) % self._capacity[slots]
        self._size[slots] = np.minimum(self._capacity[slots], self._size[slots] + num_new)

    def draw(self, slots: Indices, numbers: NDArray[np.float64]) -> Drawn:
        """Return a batch for each of some members, or U of them.

        Args:
            slots: The members' slots, (M,).
            numbers: Random numbers, uniform in [0, 1), (M, B), or (U, M, B) if the memory `draws_ahead`; not used where
                the newest transitions are taken.
        """
        if self._newest_only:
            num_rows = numbers.shape[-1]
            first = self._next.take(slots)[:, None] - num_rows
            newest = (first + np.arange(num_rows)) % self._capacity.take(slots)[:, None]
            places = np.broadcast_to(newest, numbers.shape)
        else:
            places = (numbers * self._size.take(slots)[:, None]).astype(np.int64)
        return Drawn(self._gather(slots, places))

    def _gather(self, slots: Indices, places: Indices) -> Floats:
        indices = places + self._start.take(slots)[:, None]
        rows: Floats = self._rows.take(indices.reshape(-1), axis=0).reshape(*places.shape, self.num_columns)
        return rows

    def set_priorities(self, slots: Indices, indices: Indices, td_errors: Floats) -> None:
        """Do nothing, because all rows are equally likely."""


class StackedPrioritizedReplay(StackedReplay):
    """Draws in proportion to (|TD error| + epsilon)^alpha; see `policies.replay.PrioritizedReplayBuffer`."""

    draws_ahead = False

    def __init__(self, shared: SharedByDQN, seen: Inputs) -> None:
        super().__init__(shared, seen)
        # A tree for each slot, whose leaves are the rows.
        self._priorities = SumTrees(0, 0)
        self._highest: NDArray[np.float64] = np.zeros(0)
        self._alpha: NDArray[np.float64] = np.zeros(0)
        self._beta: NDArray[np.float64] = np.zeros(0)
        self._epsilon: NDArray[np.float64] = np.zeros(0)

    @override
    def add_member(self, member_id: str, hyperparams: DQNHyperparams, most: int | None = None) -> None:
        # Before anything else is changed, as there may be too little memory for it.
        self._make_tree(self._free_slot(), self._capacity_of(hyperparams, most))
        super().add_member(member_id, hyperparams, most)
        slot = self._slots[member_id]
        if slot == len(self._highest):
            for name in ("_highest", "_alpha", "_beta", "_epsilon"):
                setattr(self, name, np.append(getattr(self, name), 0.0))
        self._highest[slot] = 1.0
        self._alpha[slot], self._beta[slot] = hyperparams.prioritized_alpha, hyperparams.prioritized_beta
        self._epsilon[slot] = hyperparams.prioritized_epsilon

    def _make_tree(self, slot: int, capacity: int) -> None:
        """Give a slot that is free a tree for a new member."""
        if slot < len(self._priorities.starts):
            self._priorities.clear(slot)
            if self._priorities.has_size(slot, capacity):
                return
        # None for other slots that are free.
        capacities = [0] * max(slot + 1, len(self._capacity))
        for taken in self._slots.values():
            capacities[taken] = int(self._capacity[taken])
        capacities[slot] = capacity
        self._priorities = self._priorities.resized(len(capacities), capacities)

    def _first(self, slots: Indices) -> Indices:
        """Return where the leaves of slots begin, (M, 1)."""
        return self._priorities.starts.take(slots)[:, None]

    def _advance(self, slots: Indices, places: Indices) -> None:
        super()._advance(slots, places)
        self._priorities.set(self._first(slots) + places, np.broadcast_to(self._highest[slots, None], places.shape))

    @override
    def draw(self, slots: Indices, numbers: NDArray[np.float64]) -> Drawn:
        totals, sizes = self._priorities.totals_of(slots)[:, None], self._size.take(slots)[:, None]
        first = self._first(slots)
        found = self._priorities.find(slots[:, None], numbers * totals)
        places = np.minimum(found - first, sizes - 1)
        shares = self._priorities.leaves[first + places] / totals
        weights = (sizes * shares) ** -self._beta.take(slots)[:, None]
        weights = (weights / weights.max(axis=1, keepdims=True)).astype(np.float32)
        return Drawn(self._gather(slots, places), weights, places)

    def set_priorities(self, slots: Indices, indices: Indices, td_errors: Floats) -> None:
        """Set the priorities of rows, (M, B), from their newest TD errors."""
        sizes = np.abs(td_errors).astype(np.float64) + self._epsilon[slots, None]
        priorities = sizes ** self._alpha[slots, None]
        priorities = np.where(np.isfinite(priorities), priorities, self._highest[slots, None])
        self._highest[slots] = np.maximum(self._highest[slots], priorities.max(axis=1, initial=0.0))
        self._priorities.set(self._first(slots) + indices, priorities)


def make_stacked_replay(shared: SharedByDQN, seen: Inputs) -> StackedReplay:
    """Return the replay memory that the hyperparameters name, without members."""
    if shared.replay == "prioritized":
        return StackedPrioritizedReplay(shared, seen)
    return StackedReplay(shared, seen)

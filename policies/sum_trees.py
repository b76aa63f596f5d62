"""Binary trees of sums, to draw rows in proportion to their priorities: for one memory or for many at once.

Words: the *leaves* of a tree are its rows' priorities, and every other node is the sum of the two under it. The
*height* of a tree is the number of levels above its leaves. Trees are stored level by level, one tree after another:
the nodes under node i of a level are nodes 2i and 2i + 1 of the next level, in every tree. So finding a leaf takes no
more additions among many trees than in one. Of trees of several sizes the largest come first: so each begins at a
multiple of its own size, and nodes above its root belong to no tree. The leaf of a row of tree t is starts[t] + row.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]
Sums = NDArray[np.float64]

_FEW = 10
"""So many neighbouring nodes take as long as one by its index."""


class SumTrees:
    """Trees of sums, whose leaves are all 0 at first.

    Args:
        num_trees: The number of trees.
        capacity: The number of rows of each, or of all alike; the number of leaves is the next power of 2, at least 2.

    Attributes:
        num_leaves: The number of leaves of the largest tree.
        starts: The first leaf of each tree.
    """

    def __init__(self, num_trees: int, capacity: int | Sequence[int]) -> None:
        capacities = [capacity] * num_trees if isinstance(capacity, int) else capacity
        self._heights: Indices = np.array([_height(each) for each in capacities], dtype=np.int64)
        highest = int(self._heights.max(initial=_height(0)))
        self.num_leaves = 1 << highest
        sizes, order = 1 << self._heights, np.argsort(-self._heights, kind="stable")
        self.starts: Indices = np.empty(num_trees, dtype=np.int64)
        self.starts[order] = sizes[order].cumsum() - sizes[order]
        # A multiple of the largest tree, so that every level has twice as many nodes as the one above it.
        total = -(-int(sizes.sum()) // self.num_leaves) * self.num_leaves
        # The operating system provides memory only for what is written, so what is 0 is left alone below.
        self._nodes: Sums = np.zeros(2 * total)
        begins = [2 * total - (2 * total >> height) for height in range(highest + 2)]
        self._levels: list[Sums] = [self._nodes[begins[at] : begins[at + 1]] for at in range(highest, -1, -1)]
        self._roots: Indices = np.array(begins, dtype=np.int64)[self._heights] + (self.starts >> self._heights)
        # The heights that there are, and the levels under each as far as the next: no tree joins on the way.
        self._turns = sorted(set(self._heights.tolist()), reverse=True) or [highest]
        ends = [highest - height + 1 for height in [*self._turns, 0]]
        self._runs = [self._levels[begin:end] for begin, end in itertools.pairwise(ends)]

    @property
    def totals(self) -> Sums:
        """The sum of each tree."""
        return self._nodes.take(self._roots)

    @property
    def leaves(self) -> Sums:
        """The leaves of all trees, one tree after another."""
        return self._levels[-1]

    def totals_of(self, trees: Indices) -> Sums:
        """Return the sums of some trees."""
        return self._nodes.take(self._roots.take(trees))

    def has_size(self, tree: int, capacity: int) -> bool:
        """Return whether a tree has as many leaves as one of this capacity."""
        return int(self._heights[tree]) == _height(capacity)

    def clear(self, tree: int) -> None:
        """Set all leaves of a tree to 0."""
        if self._nodes[self._roots[tree]]:
            for sums in self._own(tree):
                sums[:] = 0.0

    def resized(self, num_trees: int, capacity: int | Sequence[int]) -> SumTrees:
        """Return more trees or ones of other sizes with the same leaves, as far as they have room for them."""
        other = SumTrees(num_trees, capacity)
        for tree in np.flatnonzero(self.totals[:num_trees]).tolist():
            leaves, *above = other._own(tree)
            kept = self._own(tree)[0][: len(leaves)]
            leaves[: len(kept)] = kept
            below = leaves
            for sums in above:
                np.add(below[::2], below[1::2], out=sums)
                below = sums
        return other

    def _own(self, tree: int) -> list[Sums]:
        """Return a tree's nodes, from its leaves to its root."""
        start, height = int(self.starts[tree]), int(self._heights[tree])
        size = 1 << height
        return [self._levels[-1 - level][start >> level : (start + size) >> level] for level in range(height + 1)]

    def set(self, leaves: Indices, values: NDArray[Any]) -> None:
        """Set some leaves; a leaf that is named more than once gets its last value."""
        levels = self._levels
        levels[-1][leaves] = values
        nodes = leaves
        # Every level is updated, whichever the rows are, and if there are none.
        for level in range(len(levels) - 1, 0, -1):
            below, above, nodes = levels[level], levels[level - 1], nodes >> 1
            if len(above) <= _FEW * nodes.size:
                # All of it at once takes less time than these nodes one by one, and gives the others what they have.
                np.add(below[::2], below[1::2], out=above)
                continue
            # Two neighbours are one complex number: fetched at once.
            pairs = below.view(np.complex128).take(nodes)
            above[nodes] = pairs.real + pairs.imag

    def find(self, trees: Indices, heights: Sums) -> Indices:
        """Return the leaves that lie at these heights if a tree's leaves are stacked.

        Rounding may lead one step beyond the last leaf that is not 0.

        Args:
            trees: The tree of each height; or of each row of heights, (M, 1).
            heights: From 0 to the tree's total.
        """
        if len(self._runs) == 1:
            nodes = np.empty(heights.shape, dtype=np.int64)
            nodes[:] = trees
            _descend(self._runs[0], nodes, np.array(heights))
            return nodes
        # The highest trees first: then those that have nodes on a level are the first ones, and others join them below.
        rows = trees.reshape(-1)
        below = -self._heights.take(rows)
        order = below.argsort(kind="stable")
        rows, below = rows.take(order), below.take(order)
        remaining = heights.reshape(len(rows), -1).take(order, axis=0)
        nodes = np.empty(remaining.shape, dtype=np.int64)
        nodes[:] = (self.starts.take(rows) >> -below)[:, None]
        counts = below.searchsorted([-height for height in self._turns], "right").tolist()
        for levels, count in zip(self._runs, counts, strict=True):
            _descend(levels, nodes[:count], remaining[:count])
        found = np.empty_like(nodes)
        found[order] = nodes
        return found.reshape(heights.shape)


def _height(capacity: int) -> int:
    """Return how many levels are above the leaves of a tree."""
    return max(1, (capacity - 1).bit_length())


def _descend(levels: Sequence[Sums], nodes: Indices, heights: Sums) -> None:
    """Move nodes down some levels to those that heights lie in; what lies left of them is taken off the heights."""
    for sums in levels:
        nodes *= 2
        lower = sums.take(nodes)
        beyond = heights >= lower
        nodes += beyond
        # Less 0 where they do not lie beyond.
        lower *= beyond
        heights -= lower

"""Binary trees of sums, to draw rows in proportion to their priorities: for one memory or for many at once.

Words: the *leaves* of a tree are its rows' priorities, and every other node is the sum of the two under it. All trees
have the same size and are stored level by level, one tree after another: the nodes under node i of a level are nodes
2i and 2i + 1 of the next level, in every tree. So finding a leaf takes no more additions among many trees than in one.
The leaf of a row of tree t is t * num_leaves + row.
"""

from __future__ import annotations

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
        capacity: The number of rows of each; the number of leaves is the next power of 2, at least 2.
    """

    def __init__(self, num_trees: int, capacity: int) -> None:
        num_levels = max(1, (capacity - 1).bit_length())
        self.num_leaves = 1 << num_levels
        self._levels: list[Sums] = [np.zeros(num_trees << level) for level in range(num_levels + 1)]

    @property
    def totals(self) -> Sums:
        """The sum of each tree."""
        return self._levels[0]

    @property
    def leaves(self) -> Sums:
        """The leaves of all trees, one tree after another."""
        return self._levels[-1]

    def clear(self, tree: int) -> None:
        """Set all leaves of a tree to 0."""
        for level, sums in enumerate(self._levels):
            sums[tree << level : (tree + 1) << level] = 0.0

    def resized(self, num_trees: int, capacity: int) -> SumTrees:
        """Return more trees or larger ones with the same leaves."""
        other = SumTrees(num_trees, capacity)
        leaves = self.leaves.reshape(-1, self.num_leaves)
        other.leaves.reshape(-1, other.num_leaves)[: len(leaves), : self.num_leaves] = leaves
        for level in range(len(other._levels) - 1, 0, -1):
            below = other._levels[level]
            other._levels[level - 1][:] = below[::2] + below[1::2]
        return other

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
            trees: The tree of each height.
            heights: From 0 to the tree's total.
        """
        nodes, heights = np.array(trees), np.array(heights)
        for sums in self._levels[1:]:
            nodes *= 2
            lower = sums.take(nodes)
            beyond = heights >= lower
            nodes += beyond
            # Less 0 where they do not lie beyond.
            lower *= beyond
            heights -= lower
        return nodes

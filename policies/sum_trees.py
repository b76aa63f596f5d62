"""Binary trees of sums, to draw rows in proportion to their priorities: for one memory or for many at once.

Words: the *leaves* of a tree are its rows' priorities, and every other node is the sum of the two under it. All trees
are of one size, and lie level by level, one after another: the nodes under node i of a level are 2i and 2i + 1 of the
next, whichever tree they are of. So many trees cost what one does, and a row's leaf is where its tree begins + the row.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]
Sums = NDArray[np.float64]


class SumTrees:
    """Trees of sums; all leaves are 0 at first.

    Args:
        num_trees: How many.
        capacity: Rows of each; the leaves are as many or more, a power of 2.
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
        """Of all trees, one after another."""
        return self._levels[-1]

    def clear(self, tree: int) -> None:
        """Make all leaves of a tree 0."""
        for level, sums in enumerate(self._levels):
            sums[tree << level : (tree + 1) << level] = 0.0

    def resized(self, num_trees: int, capacity: int) -> SumTrees:
        """More trees or larger ones, with the leaves that are there."""
        other = SumTrees(num_trees, capacity)
        leaves = self.leaves.reshape(-1, self.num_leaves)
        other.leaves.reshape(-1, other.num_leaves)[: len(leaves), : self.num_leaves] = leaves
        for level in range(len(other._levels) - 1, 0, -1):
            below = other._levels[level]
            other._levels[level - 1][:] = below[::2] + below[1::2]
        return other

    def set(self, leaves: Indices, values: NDArray[Any]) -> None:
        """Set some leaves; of one that is named more than once the last value stays."""
        levels = self._levels
        levels[-1][leaves] = values
        nodes = leaves
        # All levels, whatever the rows are, and if there are none.
        for level in range(len(levels) - 1, 0, -1):
            below, nodes = levels[level], nodes >> 1
            left = 2 * nodes
            levels[level - 1][nodes] = below[left] + below[left + 1]

    def find(self, trees: Indices, heights: Sums) -> Indices:
        """The leaves at these heights of the stack of a tree's leaves.

        Rounding may lead one step beyond the last leaf that is not 0.

        Args:
            trees: Of each height its tree.
            heights: From 0 to the tree's total.
        """
        nodes = trees
        for sums in self._levels[1:]:
            left = 2 * nodes
            lower = sums[left]
            beyond = heights >= lower
            heights = np.where(beyond, heights - lower, heights)
            nodes = left + beyond
        return nodes

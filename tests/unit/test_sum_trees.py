"""Sums of priorities: of one memory, of many, and of those that grow."""

import itertools

import numpy as np
import pytest

from policies.sum_trees import SumTrees


def check_sums(trees: SumTrees) -> None:
    """Every node is the sum of the two under it."""
    for above, below in itertools.pairwise(trees._levels):
        np.testing.assert_array_equal(above, below[::2] + below[1::2])


@pytest.mark.parametrize("capacity", [1, 2, 3, 64, 65])
def test_any_height_leads_to_the_leaf_that_it_is_in(capacity: int) -> None:
    rng = np.random.default_rng(capacity)
    trees = SumTrees(3, capacity)
    assert capacity <= trees.num_leaves
    values = rng.integers(0, 4, (3, capacity)).astype(np.float64)
    values[:, 0] += 1.0
    for tree in range(3):
        trees.set(tree * trees.num_leaves + np.arange(capacity), values[tree])
    check_sums(trees)
    np.testing.assert_array_equal(trees.totals, values.sum(axis=1))
    for tree in range(3):
        heights = np.arange(values[tree].sum())
        found = trees.find(np.full(len(heights), tree), heights)
        expected = np.repeat(np.arange(capacity), values[tree].astype(int))
        np.testing.assert_array_equal(found, tree * trees.num_leaves + expected)


def test_several_trees_are_each_as_if_alone() -> None:
    rng = np.random.default_rng(1)
    together, alone = SumTrees(4, 100), [SumTrees(1, 100) for _ in range(4)]
    first = together.num_leaves * np.arange(4)[:, None]
    for _ in range(50):
        places, values = rng.integers(0, 100, (4, 32)), rng.random((4, 32))
        together.set(first + places, values)
        heights = rng.random((4, 32)) * together.totals[:, None]
        found = together.find(np.arange(4)[:, None].repeat(32, axis=1), heights) - first
        for tree in range(4):
            alone[tree].set(places[tree], values[tree])
            np.testing.assert_array_equal(together.totals[tree], alone[tree].totals[0])
            np.testing.assert_array_equal(found[tree], alone[tree].find(np.zeros(32, dtype=np.int64), heights[tree]))


def test_of_a_leaf_that_is_set_twice_at_once_the_last_value_stays() -> None:
    trees = SumTrees(1, 4)
    trees.set(np.array([2, 2, 0]), np.array([1.0, 3.0, 5.0]))
    np.testing.assert_array_equal(trees.leaves, [5, 0, 3, 0])
    check_sums(trees)
    trees.set(np.zeros(0, dtype=np.int64), np.zeros(0))
    assert trees.totals.tolist() == [8]


def test_trees_that_grow_keep_their_leaves_and_one_is_cleared_alone() -> None:
    trees = SumTrees(0, 0).resized(2, 3)
    trees.set(np.array([0, 1, 2, 4, 6]), np.array([1.0, 2.0, 3.0, 4.0, 5.0]))
    larger = trees.resized(3, 5)
    assert larger.leaves.reshape(3, 8).tolist() == [[1, 2, 3, *[0] * 5], [4, 0, 5, *[0] * 5], [0] * 8]
    check_sums(larger)
    larger.clear(0)
    assert larger.totals.tolist() == [0, 9, 0]
    check_sums(larger)


def test_trees_of_different_sizes_are_each_as_if_alone() -> None:
    rng, sizes = np.random.default_rng(2), [5, 1000, 2, 64, 1000, 33, 1]
    together, alone = SumTrees(len(sizes), sizes), [SumTrees(1, size) for size in sizes]
    assert len(together.leaves) == 3 * 1024
    slots = np.arange(len(sizes))[:, None]
    for _ in range(50):
        some = rng.permutation(slots)[: rng.integers(1, len(sizes) + 1)]
        places = rng.integers(0, np.array(sizes)[some], (len(some), 16))
        values, shares = rng.random(places.shape), rng.random(places.shape)
        together.set(together.starts[some] + places, values)
        for row, tree in enumerate(some[:, 0]):
            alone[tree].set(places[row], values[row])
        np.testing.assert_array_equal(together.totals, [each.totals[0] for each in alone])
        np.testing.assert_array_equal(together.totals_of(some[:, 0]), together.totals[some[:, 0]])
        heights = shares * together.totals[some]
        found = together.find(some, heights)
        np.testing.assert_array_equal(found, together.find(np.broadcast_to(some, heights.shape), heights))
        for row, tree in enumerate(some[:, 0]):
            expected = alone[tree].find(np.zeros(16, dtype=np.int64), heights[row])
            np.testing.assert_array_equal(found[row] - together.starts[tree], expected)


def test_trees_of_different_sizes_keep_their_leaves_when_others_come_or_grow() -> None:
    trees = SumTrees(3, [3, 20, 1])
    leaves = [np.array([1.0, 2.0, 3.0]), np.arange(20.0), np.array([7.0]), np.zeros(0)]
    for tree, values in enumerate(leaves[:3]):
        trees.set(trees.starts[tree] + np.arange(len(values)), values)
    for sizes in ([3, 20, 1, 200], [50, 20, 1], [3, 100, 40], [3, 20, 1]):
        other = trees.resized(len(sizes), sizes)
        np.testing.assert_array_equal(other.totals, [6, 190, 7, 0][: len(sizes)])
        for tree, (values, size) in enumerate(zip(leaves, sizes, strict=False)):
            assert other.has_size(tree, size)
            found = other.leaves[other.starts[tree] :][:size]
            np.testing.assert_array_equal(found[: len(values)], values)
            assert not found[len(values) :].any()
        other.clear(1)
        np.testing.assert_array_equal(other.totals, [6, 0, 7, 0][: len(sizes)])
        assert other.leaves.sum() == 13
    assert not trees.has_size(0, 5)
    np.testing.assert_array_equal(trees.resized(3, [3, 2, 1]).totals, [6, 1, 7])

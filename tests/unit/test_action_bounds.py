"""Actions of a policy become actions of the env, each component by its own bounds."""

from collections.abc import Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

from policies.acting.policy import action_transform
from policies.envs.action_bounds import ToBounds

INF = np.inf


def box(
    low: Sequence[float | np.float32] | NDArray[Any] | tuple[float, ...],
    high: Sequence[float | np.float32] | NDArray[Any] | tuple[float, ...],
    dtype: type[np.floating[Any]] = np.float32,
) -> gym.spaces.Box:
    return gym.spaces.Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)


def test_two_bounds_stretch_and_clip() -> None:
    actions = ToBounds(box([-2, 0], [2, 1]))(np.array([[-1, -1], [0, 0], [0.5, 3], [-7, 1]], np.float32))
    np.testing.assert_array_equal(actions, [[-2, 0], [0, 0.5], [1, 1], [-2, 1]])


def test_one_bound_clips_and_none_changes_nothing() -> None:
    actions = ToBounds(box([0, -INF, -INF], [INF, 0.5, INF]))(np.array([[-1, -1, -7], [3, 3, 3]], np.float32))
    np.testing.assert_array_equal(actions, [[0, -1, -7], [3, 0.5, 3]])


def test_a_component_does_not_depend_on_the_others() -> None:
    bounds = [(-2, 2), (0, INF), (-INF, 1), (-INF, INF), (5, 9)]
    actions = np.random.default_rng(0).normal(size=(50, 5)).astype(np.float32) * 3
    together = ToBounds(box(*cast("Any", zip(*bounds, strict=True))))(actions)
    for index, (low, high) in enumerate(bounds):
        alone = ToBounds(box([low], [high]))(actions[:, index : index + 1])
        np.testing.assert_array_equal(together[:, index : index + 1], alone)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.longdouble])
def test_every_action_is_one_of_the_space(dtype: type[np.floating[Any]]) -> None:
    rng = np.random.default_rng(1)
    drawn = rng.normal(size=(100, 6)).astype(np.float32) * 5
    for _ in range(20):
        low, high = np.sort(rng.normal(size=(2, 6)).astype(dtype), axis=0)
        low[rng.random(6) < 0.4], high[rng.random(6) < 0.4] = -INF, INF
        space = box(low, high, dtype)
        actions = ToBounds(space)(drawn)
        assert actions.dtype == space.dtype
        assert all(space.contains(action) for action in actions)


def test_fully_bounded_actions_are_those_of_the_formula_to_the_last_bit() -> None:
    space = box([-0.3, 1e-3], [0.7, 9.1])
    actions = np.random.default_rng(2).normal(size=(200, 2)).astype(np.float32)
    expected = np.clip(space.low + (actions + 1.0) * (space.high - space.low) / 2.0, space.low, space.high)
    np.testing.assert_array_equal(ToBounds(space)(actions), expected)


def test_bounds_as_large_as_the_format_are_none() -> None:
    most = np.finfo(np.float32).max
    np.testing.assert_array_equal(ToBounds(box([-most, 0], [most, most]))(np.array([[-1, -2]], np.float32)), [[-1, 0]])


def test_policy_files_name_what_happened_in_training() -> None:
    assert action_transform(gym.spaces.Discrete(2)) == "none"
    assert action_transform(box([-1, 0], [1, 1])) == "unsquash"
    assert action_transform(box([-1, 0], [1, INF])) == "by_component"
    assert action_transform(box([-INF], [INF])) == "by_component"

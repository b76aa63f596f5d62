"""Statistics of observations: found in parts, so that images need little memory, and the same to the bit as at once."""

from __future__ import annotations

import tracemalloc
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from packed_members import random_member
from torch import nn

from policies.networks.layers import ObservationStatistics, column_blocks
from policies.packed.member import OBS_COUNT, OBS_MEAN, OBS_VAR
from policies.packed.sampling import merge_statistics

Numbers = dict[str, NDArray[Any]]
BYTES = {np.uint8: 1 / 255}
"""The scale of numbers of a kind, unless it is 1."""
SHAPES = [(1,), (2,), (17,), (511,), (1_023,), (1_024,), (1_025,), (1_537,), (3_001,), (36, 36, 1), (28, 31, 4)]


def learned(shape: tuple[int, ...]) -> Numbers:
    """Statistics of 100 observations before."""
    rng = np.random.default_rng(1)
    mean, variance = rng.normal(size=shape).astype(np.float32), rng.random(shape).astype(np.float32)
    return {OBS_MEAN: mean, OBS_VAR: variance, OBS_COUNT: np.array(100)}


def observed(num_rows: int, shape: tuple[int, ...], kind: Any) -> NDArray[Any]:
    rng = np.random.default_rng(0)
    if kind is np.uint8:
        return rng.integers(0, 256, (num_rows, *shape), dtype=np.uint8)
    return rng.normal(3.0, 50.0, (num_rows, *shape)).astype(kind)


def merged(weights: Numbers, rows: NDArray[Any], scale: float) -> Numbers:
    member = random_member("m")
    member.weights |= weights
    merge_statistics(member, rows.reshape(len(rows), -1), scale)
    return {name: member.weights[name] for name in weights}


def merged_at_once(weights: Numbers, rows: NDArray[Any], scale: float) -> Numbers:
    """The formula of Chan et al. 1979 with the whole batch in float64."""
    batch = rows.astype(np.float64) * scale
    mean, count, num_new = batch.mean(axis=0), int(weights[OBS_COUNT]), len(rows)
    total, delta = count + num_new, mean - weights[OBS_MEAN]
    squares = weights[OBS_VAR].astype(np.float64) * count + ((batch - mean) ** 2).sum(axis=0)
    squares += delta**2 * (count * num_new / total)
    return {
        OBS_MEAN: (weights[OBS_MEAN] + delta * (num_new / total)).astype(np.float32),
        OBS_VAR: (squares / total).astype(np.float32),
        OBS_COUNT: np.array(total),
    }


class Statistics(ObservationStatistics, nn.Module):
    def __init__(self, shape: tuple[int, ...], kind: Any, weights: Numbers) -> None:
        super().__init__()
        limit: Any = 255 if kind is np.uint8 else np.inf
        self.observation_space = gym.spaces.Box(0 if kind is np.uint8 else -limit, limit, shape, kind)
        self.model_config = {"normalize_observations": True}
        self.add_statistics()
        # As where observations are images.
        self._observation_scale = BYTES.get(kind, 1.0)
        for name in (OBS_MEAN, OBS_VAR, OBS_COUNT):
            self.get_buffer(name).copy_(torch.from_numpy(weights[name]))


def merged_at_once_by_torch(weights: Numbers, rows: NDArray[Any], scale: float) -> Numbers:
    batch = torch.from_numpy(rows).double() * scale
    mean, count, num_new = batch.mean(dim=0), int(weights[OBS_COUNT]), len(rows)
    old_mean, old_variance = (torch.from_numpy(weights[name]) for name in (OBS_MEAN, OBS_VAR))
    total, delta = count + num_new, mean - old_mean
    squares = old_variance.double() * count + ((batch - mean) ** 2).sum(dim=0) + delta**2 * (count * num_new / total)
    return {
        OBS_MEAN: (old_mean.double() + delta * (num_new / total)).float().numpy(),
        OBS_VAR: (squares / total).float().numpy(),
        OBS_COUNT: np.array(total),
    }


@pytest.mark.parametrize("kind", [np.uint8, np.float32, np.float64])
@pytest.mark.parametrize("num_rows", [1, 2, 37])
def test_statistics_in_parts_are_those_of_all_at_once_to_the_bit(num_rows: int, kind: Any) -> None:
    scale = BYTES.get(kind, 1.0)
    for shape in SHAPES:
        weights, rows = learned(shape), observed(num_rows, shape, kind)
        kept = rows.copy()
        found, known = merged(weights, rows, scale), merged_at_once(weights, rows, scale)
        statistics = Statistics(shape, kind, weights)
        statistics.update_observation_statistics(rows)
        by_torch = merged_at_once_by_torch(weights, rows, scale)
        for name in weights:
            np.testing.assert_array_equal(found[name], known[name], strict=True)
            np.testing.assert_array_equal(statistics.get_buffer(name).numpy(), by_torch[name], strict=True)
        # What is learned from is not changed.
        assert np.array_equal(rows, kept)


def test_what_rounding_alone_leaves_of_a_sum_is_the_same() -> None:
    """Means that are 0 but for rounding show the order of the sums, which is hidden otherwise in 24 bits."""
    rng = np.random.default_rng(2)
    for shape in SHAPES:
        half = rng.normal(0.0, 1e6, (50, *shape))
        rows = rng.permuted(np.concatenate([half, -half]), axis=0)
        weights = {OBS_MEAN: np.zeros(shape, np.float32), OBS_VAR: np.ones(shape, np.float32), OBS_COUNT: np.array(0)}
        found, known = merged(weights, rows, 1.0), merged_at_once(weights, rows, 1.0)
        statistics = Statistics(shape, np.float64, weights)
        statistics.update_observation_statistics(rows)
        by_torch = merged_at_once_by_torch(weights, rows, 1.0)
        assert 0 < np.abs(known[OBS_MEAN]).max() < 1e-8
        np.testing.assert_array_equal(found[OBS_MEAN], known[OBS_MEAN])
        np.testing.assert_array_equal(statistics.obs_mean.numpy(), by_torch[OBS_MEAN])


def test_parts_are_of_a_size_and_none_is_of_a_single_number() -> None:
    for size in (1, 2, 348, 1_023, 1_024, 1_025, 28_224, 28_225):
        parts = list(column_blocks(size))
        assert [index for part in parts for index in range(size)[part]] == list(range(size))
        assert len(parts) == max(1, size // 512)
        assert size == 1 or min(part.stop - part.start for part in parts) > 1


class Peak(torch.overrides.TorchFunctionMode):
    """Keeps the size of the largest tensor that is made."""

    def __init__(self) -> None:
        super().__init__()
        self.num_bytes = 0

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = func(*args, **(kwargs or {}))
        if isinstance(made, torch.Tensor) and made.dtype == torch.float64:
            self.num_bytes = max(self.num_bytes, made.nbytes)
        return made


def test_statistics_of_images_need_less_memory_than_the_images() -> None:
    shape = (84, 84, 4)
    weights, rows = learned(shape), observed(256, shape, np.uint8)
    member = random_member("m")
    member.weights |= weights
    tracemalloc.start()
    try:
        merge_statistics(member, rows.reshape(256, -1), 1 / 255)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # The whole batch in float64 is 8 times the bytes.
    assert peak < rows.nbytes
    statistics = Statistics(shape, np.uint8, weights)
    with Peak() as largest:
        statistics.update_observation_statistics(rows)
    assert 0 < largest.num_bytes < rows.nbytes / 2

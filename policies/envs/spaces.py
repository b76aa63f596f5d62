"""Write Box and Discrete spaces as JSON objects and read them again, and choose the dtype of observations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.errors import MALFORMED, CheckpointError

_MAX_SIZE = 10_000_000
"""The most numbers an observation may have: 25 times as many as four frames of an Atari screen."""


def observation_dtype(space: gym.Space[Any]) -> type[np.uint8 | np.float32]:
    """Return the dtype that observations are stored in: images stay bytes, which take a quarter of the memory."""
    return np.uint8 if space.dtype == np.uint8 else np.float32


def describe_space(space: gym.Space[Any]) -> dict[str, Any]:
    """Return a Box or Discrete space as a JSON object.

    Infinite bounds become the strings "inf" and "-inf". Bounds that are all equal become one number, because the bounds
    of an image would fill pages.

    Raises:
        CheckpointError: The space is of another kind.
    """
    if isinstance(space, gym.spaces.Box):
        return {
            "type": "box",
            "shape": [int(size) for size in space.shape],
            "low": _bounds_to_json(space.low),
            "high": _bounds_to_json(space.high),
            "dtype": str(space.dtype),
        }
    if isinstance(space, gym.spaces.Discrete):
        return {"type": "discrete", "n": int(space.n), "start": int(space.start)}
    raise CheckpointError(
        f"A policy file cannot describe a space of kind {type(space).__name__}.",
        "Use Box or Discrete spaces.",
    )


def space_from_description(description: Mapping[str, Any]) -> gym.spaces.Box | gym.spaces.Discrete[Any]:
    """Return the space that `describe_space` described.

    Raises:
        CheckpointError: The description is incomplete or contradicts itself.
    """
    try:
        if description["type"] == "discrete":
            return gym.spaces.Discrete(int(description["n"]), start=int(description.get("start", 0)))
        if description["type"] == "box":
            dtype = np.dtype(description["dtype"])
            shape = tuple(int(size) for size in description["shape"])
            # Checked before an array of that size is made.
            if min(shape, default=0) < 0 or math.prod(shape) > _MAX_SIZE:
                raise ValueError(f"its shape is {shape}")
            low, high = (_bounds_from_json(description[key], shape, dtype) for key in ("low", "high"))
            return gym.spaces.Box(low, high, shape, dtype.type)
    except MALFORMED as error:
        raise CheckpointError(
            f"A space is described as {str(description)[:200]}, which makes none: {str(error)[:200]}.",
            "Write the policy file again from its checkpoint.",
        ) from error
    raise CheckpointError(
        f"A space is described as of type {str(description['type'])[:80]!r}; known are 'box' and 'discrete'.",
        "Write the policy file again from its checkpoint, or update tune-jobs.",
    )


def _bounds_to_json(bounds: NDArray[Any]) -> Any:
    if bounds.size > 1 and np.all(bounds == bounds.flat[0]):
        return _numbers_to_json(bounds.flat[0].item())
    return _numbers_to_json(bounds.tolist())


def _bounds_from_json(value: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    numbers = np.array(_numbers_from_json(value), dtype=dtype)
    return np.full(shape, numbers) if numbers.ndim == 0 else numbers.reshape(shape)


def _numbers_to_json(value: Any) -> Any:
    if isinstance(value, list):
        return [_numbers_to_json(item) for item in value]
    if isinstance(value, np.floating):  # a long double, which no Python number holds
        value = float(value)
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _numbers_from_json(value: Any) -> Any:
    return [_numbers_from_json(item) for item in value] if isinstance(value, list) else float(value)

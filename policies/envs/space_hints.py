"""Suggest a wrapper for an environment with unsupported spaces, as an expression of Gymnasium's own wrappers.

The expressions lack only the imports of `gymnasium`, `numpy` and an env's own module. A test evaluates each of them.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np

_HOW = "Wrap it in a module of your own, as 'Other spaces' in docs/guides/own-environment.md shows"
_MAX_COMBINATIONS = 10_000


def observation_hint(env_id: str, space: gym.Space[Any]) -> str:
    """Suggest what turns these observations into vectors of float32, or into images."""
    if not space.is_np_flattenable or 0 in (space.shape or ()):
        return f"{_HOW}, in a gymnasium.ObservationWrapper that makes a vector of float32 of an observation."
    env, dimensions = _make(env_id), len(space.shape or ()) if isinstance(space, gym.spaces.Box) else 0
    if dimensions == 2 and space.dtype == np.uint8:
        env = f"gymnasium.wrappers.ReshapeObservation({env}, {(*(space.shape or ()), 1)})"
        return f"{_HOW}: `{env}` makes images of one channel of them."
    if dimensions not in (1, 3):
        env = f"gymnasium.wrappers.FlattenObservation({env})"
    if not np.issubdtype(gym.spaces.flatten_space(space).dtype, np.floating):
        env = f"gymnasium.wrappers.DtypeObservation({env}, numpy.float32)"
    has_choices = any(isinstance(part, (gym.spaces.Discrete, gym.spaces.MultiDiscrete)) for part in _parts(space))
    what = (
        "images" if dimensions == 3 else "vectors, with a 1 at the place of each choice," if has_choices else "vectors"
    )
    return f"{_HOW}: `{env}` makes {what} of float32 of them."


def action_hint(env_id: str, space: gym.Space[Any]) -> str:
    """Suggest what turns these actions into Discrete or 1-D Box actions."""
    env = _make(env_id)
    sizes = _combinations(space)
    if sizes is not None and math.prod(sizes) <= _MAX_COMBINATIONS:
        shape = f", {space.shape}" if len(space.shape or ()) > 1 else ""
        parts = f"numpy.stack(numpy.unravel_index(action, {sizes}))"
        action = f"numpy.reshape({parts}{shape})" if shape else parts
        wrapped = (
            f"gymnasium.wrappers.TransformAction({env}, lambda action: {action}, "
            f"gymnasium.spaces.Discrete({math.prod(sizes)}))"
        )
        return f"{_HOW}: `{wrapped}` has one action for each combination."
    if isinstance(space, gym.spaces.Box) and np.issubdtype(space.dtype, np.floating) and 0 not in space.shape:
        flat = f"gymnasium.spaces.flatten_space({env}.action_space)"
        wrapped = (
            f"gymnasium.wrappers.TransformAction({env}, lambda action: numpy.reshape(action, {space.shape}), {flat})"
        )
        return f"{_HOW}: `{wrapped}` has 1-D Box actions."
    return f"{_HOW}, in a gymnasium.ActionWrapper with Discrete or 1-D floating-point Box actions."


def _make(env_id: str) -> str:
    module, colon, name = env_id.partition(":")
    return f"{module}.{name}()" if colon and name.isidentifier() else f"gymnasium.make({env_id!r})"


def _parts(space: gym.Space[Any]) -> list[gym.Space[Any]]:
    if isinstance(space, gym.spaces.Dict):
        return [part for inner in space.spaces.values() for part in _parts(inner)]
    if isinstance(space, gym.spaces.Tuple):
        return [part for inner in space.spaces for part in _parts(inner)]
    return [space]


def _combinations(space: gym.Space[Any]) -> tuple[int, ...] | None:
    """Return how many choices each number of an action has; None if they are not choices counted from 0."""
    if isinstance(space, gym.spaces.MultiBinary):
        return (2,) * int(np.prod(space.shape))
    if isinstance(space, gym.spaces.MultiDiscrete) and not np.any(space.start):
        return tuple(int(size) for size in np.ravel(space.nvec))
    return None

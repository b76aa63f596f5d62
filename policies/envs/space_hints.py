"""Suggest a wrapper for an environment with unsupported spaces, as an expression of Gymnasium's own wrappers.

The expressions lack only the imports of `gymnasium`, `numpy` and an env's own module. A test evaluates each of them.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from policies.envs.flat import FlatBox, named

_HOW = "Wrap it in a module of your own, as 'Spaces' in docs/guides/own-environment.md shows"
_MAX_COMBINATIONS = 10_000
_MOST_NAMED = 4


def observation_hint(env_id: str, space: gym.Space[Any]) -> str:
    """Suggest what makes vectors of observations of which `policies.envs.flat` makes none."""
    taken = _taken_members(space)
    if taken:
        filtered = f"gymnasium.wrappers.FilterObservation({_make(env_id)}, {taken})"
        return f"{_HOW}: `{filtered}` leaves out what cannot be taken."
    # Texts are: Gymnasium counts their letters.
    if _is_flattenable(space) and 0 not in (space.shape or ()):
        flat = f"gymnasium.wrappers.FlattenObservation({_make(env_id)})"
        return f"{_HOW}: `{flat}` makes vectors of them."
    return f"{_HOW}, in a gymnasium.ObservationWrapper that makes a vector of float32 of an observation."


def _taken_members(space: gym.Space[Any]) -> list[str]:
    """Return the members of Dict observations of which vectors can be made; empty: none, or it is no Dict."""
    found = []
    for name, member in space.spaces.items() if isinstance(space, gym.spaces.Dict) else ():
        with contextlib.suppress(ValueError):
            FlatBox(member)
            found.append(name)
    return found


def _is_flattenable(space: gym.Space[Any]) -> bool:
    try:
        return space.is_np_flattenable
    except NotImplementedError:  # a space of somebody's own need not say
        return False


def channels_last_hint(env_id: str, space: gym.Space[Any], shape: tuple[int, ...]) -> str:
    """Suggest what puts the channels of images last.

    Args:
        env_id: The env's id.
        space: The space of its images, or of stacks of them.
        shape: The shape of one image, (channels, rows, columns).
    """
    assert isinstance(space, gym.spaces.Box)
    low, high = (_number(bound) for bound in (space.low.min(), space.high.max()))
    box = f"gymnasium.spaces.Box({low}, {high}, {(*shape[1:], shape[0])}, numpy.{space.dtype})"
    move = "lambda image: numpy.moveaxis(image, 0, -1)"
    return f"{_HOW}: `gymnasium.wrappers.TransformObservation({_make(env_id)}, {move}, {box})` puts the channels last."


def image_alone_hint(env_id: str, keys: tuple[Any, ...]) -> str:
    """Suggest what observes one member of Dict or Tuple observations, an image, alone; the keys lead to it."""
    env, member = _make(env_id), named(keys, "")
    alone = (
        f"gymnasium.wrappers.TransformObservation({env}, lambda seen: seen{member}, {env}.observation_space{member})"
    )
    return f"{_HOW}: `{alone}` observes the image alone."


def named_images(images: Iterable[tuple[Any, ...]]) -> str:
    """Return what images are called, by the keys that lead to each: observation['depth'] and observation['rgb']."""
    *names, last = map(named, images)
    if len(names) >= _MOST_NAMED:
        names, last = names[: _MOST_NAMED - 1], f"{len(names) + 2 - _MOST_NAMED} more"
    return f"{', '.join(names)} and {last}" if names else last


def one_image_hint(env_id: str, space: gym.Space[Any], images: Sequence[tuple[Any, ...]]) -> str:
    """Suggest what leaves one image of several, and everything that is none.

    Args:
        env_id: The env's id.
        space: The space of its observations, with their mask.
        images: The keys that lead to each image.
    """
    dropped = {keys[0] for keys in images[1:]}
    if not isinstance(space, gym.spaces.Dict) or images[0][0] in dropped:
        return image_alone_hint(env_id, images[0])
    kept = [name for name in space.spaces if name not in dropped]
    return f"{_HOW}: `gymnasium.wrappers.FilterObservation({_make(env_id)}, {kept})` leaves the other images out."


def _number(value: Any) -> str:
    return str(value.item()).replace("inf", "numpy.inf")


def action_hint() -> str:
    """Suggest what turns actions that no policy gives into such as policies give."""
    return f"{_HOW}, in a gymnasium.ActionWrapper whose actions are all choices, or all numbers."


def one_choice_hint(env_id: str, space: gym.Space[Any], mask: str | None = None) -> str:
    """Suggest what turns several choices at once into a single one.

    Args:
        env_id: The env's id.
        space: The space of its actions.
        mask: Where its mask of them is, in words; None: it has none.
    """
    if mask is not None:
        # No wrapper of Gymnasium's changes a mask.
        return (
            f"{_HOW}, in a gymnasium.ActionWrapper with one Discrete action for each combination, and have {mask} say "
            "which combinations are allowed: a zero or a one for each, not for each value of each choice."
        )
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
    return f"{_HOW}, in a gymnasium.ActionWrapper with Discrete actions."


def _make(env_id: str) -> str:
    module, colon, name = env_id.partition(":")
    return f"{module}.{name}()" if colon and name.isidentifier() else f"gymnasium.make({env_id!r})"


def _combinations(space: gym.Space[Any]) -> tuple[int, ...] | None:
    """Return how many choices each number of an action has; None if they are not choices counted from 0."""
    if isinstance(space, gym.spaces.MultiBinary):
        return (2,) * int(np.prod(space.shape))
    if isinstance(space, gym.spaces.MultiDiscrete) and not np.any(space.start):
        return tuple(int(size) for size in np.ravel(space.nvec))
    return None

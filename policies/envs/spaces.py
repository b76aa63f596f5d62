"""Write spaces as JSON objects and read them again, and choose the dtype of observations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.envs.flat import MAX_SIZE, FlatBox, leaves
from policies.envs.masks import MaskedBox
from policies.envs.own_actions import Choices, is_bounded, is_made, made_of
from policies.envs.stacked import StackedBox
from policies.errors import MALFORMED, CheckpointError, shortened

_FLAT = "made_of"
"""In the description of the vectors that observations are made, the space of the observations themselves."""
_OWN = "sent_as"
"""In the description of actions as policies give them, the space of the environment's own."""
_FRAMES = "frames"
"""In the description of the vectors of several observations at once, their number."""
_MASK = "mask"
_LISTS_FROM = "lists_from"
"""In the description of vectors that begin with a mask, how many values each choice has, and the mask's member."""
PolicyActions = gym.spaces.Box | gym.spaces.Discrete[Any] | Choices
"""The spaces of actions that policies give."""


def observation_dtype(space: gym.Space[Any]) -> type[np.uint8 | np.float32]:
    """Return the dtype that observations are stored in: images stay bytes, which take a quarter of the memory."""
    return np.uint8 if space.dtype == np.uint8 else np.float32


def describe_space(space: gym.Space[Any]) -> dict[str, Any]:
    """Return the space of a policy's observations or actions as a JSON object.

    Infinite bounds become the strings "inf" and "-inf". Bounds that are all equal become one number, because the bounds
    of an image would fill pages. A `FlatBox`, a `MaskedBox`, `Choices` and `Numbers` have keys for what they are made
    of, too.

    Raises:
        CheckpointError: The space is of another kind.
    """
    if isinstance(space, MaskedBox):
        own = {} if space.original is None else {_FLAT: _describe_any(space.original)}
        own |= _describe_frames(space.seen)
        lists = {} if space.lists_from is None else {_LISTS_FROM: space.lists_from}
        return {**_describe_box(space), **own, _MASK: {"sizes": list(space.sizes), "key": space.key, **lists}}
    if isinstance(space, FlatBox):
        return {**_describe_box(space), _FLAT: _describe_any(space.original)}
    if isinstance(space, StackedBox):
        return {**_describe_box(space), **_describe_frames(space)}
    if is_made(space):
        return {**_describe_any(space), _OWN: _describe_any(space.original)}
    if isinstance(space, gym.spaces.Box | gym.spaces.Discrete):
        return _describe_any(space)
    raise _cannot_describe(space)


def _describe_frames(space: gym.Space[Any]) -> dict[str, Any]:
    """Return what describes several observations at once, beside their vectors; empty for what is none."""
    if not isinstance(space, StackedBox):
        return {}
    return {_FLAT: _describe_any(space.frame.original), _FRAMES: space.num_frames}


def _describe_any(space: gym.Space[Any]) -> dict[str, Any]:
    if isinstance(space, gym.spaces.Box):
        return _describe_box(space)
    if isinstance(space, gym.spaces.Discrete):
        return {"type": "discrete", "n": int(space.n), "start": int(space.start)}
    if isinstance(space, gym.spaces.MultiDiscrete):
        dtype = {} if space.dtype == np.int64 else {"dtype": str(space.dtype)}
        return {"type": "multi_discrete", "nvec": space.nvec.tolist(), "start": space.start.tolist(), **dtype}
    if isinstance(space, gym.spaces.MultiBinary):
        return {"type": "multi_binary", "shape": [int(size) for size in space.shape]}
    if isinstance(space, gym.spaces.Dict):
        return {"type": "dict", "members": [[key, _describe_any(inner)] for key, inner in space.spaces.items()]}
    if isinstance(space, gym.spaces.Tuple):
        return {"type": "tuple", "members": [_describe_any(inner) for inner in space.spaces]}
    raise _cannot_describe(space)


def _describe_box(space: gym.spaces.Box) -> dict[str, Any]:
    return {
        "type": "box",
        "shape": [int(size) for size in space.shape],
        "low": _bounds_to_json(space.low),
        "high": _bounds_to_json(space.high),
        "dtype": str(space.dtype),
    }


def _cannot_describe(space: gym.Space[Any]) -> CheckpointError:
    return CheckpointError(
        f"A policy file cannot describe a space of kind {type(space).__name__}.",
        "Use Box or Discrete spaces.",
    )


def space_from_description(description: Mapping[str, Any]) -> PolicyActions:
    """Return the space that `describe_space` described.

    Raises:
        CheckpointError: The description is incomplete or contradicts itself.
    """
    try:
        made: gym.Space[Any] | None = None
        if (mask := description.get(_MASK)) is not None:
            made = _masked(description, mask)
        elif (original := description.get(_FLAT)) is not None:
            made = _flat(original, description.get(_FRAMES))
        elif (original := description.get(_OWN)) is not None:
            made = made_of(_any_from_description(original))
        if made is not None:
            _check_same(made, description)
        elif description["type"] in ("box", "discrete"):
            made = _any_from_description(description)
    except MALFORMED as error:
        raise CheckpointError(
            f"A space is described as {str(description)[:200]}, which makes none: {str(error)[:200]}.",
            "Write the policy file again from its checkpoint.",
        ) from error
    if isinstance(made, gym.spaces.Box | gym.spaces.Discrete | Choices):
        return made
    raise _unknown(description)


def _masked(description: Mapping[str, Any], mask: Mapping[str, Any]) -> MaskedBox:
    sizes, key, lists_from = tuple(int(size) for size in mask["sizes"]), mask["key"], mask.get(_LISTS_FROM)
    if min(sizes) < 1 or sum(sizes) > MAX_SIZE or not (key is None or isinstance(key, str)):
        raise ValueError(f"a mask {mask}")
    if lists_from is not None and (type(lists_from) is not int or len(sizes) > 1 or key is not None):
        raise ValueError(f"a mask {mask}")
    original, num_frames = description.get(_FLAT), description.get(_FRAMES)
    if original is not None and num_frames is not None:
        return MaskedBox(_flat(original, num_frames), sizes, lists_from=lists_from)
    if original is not None:
        return MaskedBox.of(_any_from_description(original), sizes, key, lists_from)
    whole = _any_from_description(description)
    assert isinstance(whole, gym.spaces.Box)
    behind = slice(sum(sizes), None)
    seen = gym.spaces.Box(whole.low[behind], whole.high[behind], dtype=np.float32)
    return MaskedBox(seen, sizes, lists_from=lists_from)


def _flat(original: Mapping[str, Any], num_frames: int | None) -> FlatBox | StackedBox:
    """Return the vectors that observations of a described space are made, or those of several at once.

    Raises:
        ValueError: There are none, or too many.
    """
    frame = FlatBox(_any_from_description(original))
    if num_frames is None:
        return frame
    if type(num_frames) is not int or not 1 < num_frames <= MAX_SIZE // math.prod(frame.shape):
        raise ValueError(f"{num_frames!r} observations of shape {frame.shape} at once")
    return StackedBox(frame, num_frames)


def _check_same(made: gym.Space[Any], description: Mapping[str, Any]) -> None:
    """Check that a space is of the type, shape and dtype of its description.

    Raises:
        ValueError: It is not.
    """
    found = _describe_any(made)
    if any(found[name] != description[name] for name in ("type", "shape", "dtype", "nvec") if name in found):
        raise ValueError(f"it makes {made!r}")


def _unknown(description: Mapping[str, Any]) -> CheckpointError:
    return CheckpointError(
        f"A space is described as of type {str(description['type'])[:80]!r}; known are 'box' and 'discrete', and "
        f"'multi_discrete' of actions with what they are {_OWN.replace('_', ' ')}.",
        "Write the policy file again from its checkpoint, or update tune-jobs.",
    )


def _any_from_description(description: Mapping[str, Any]) -> gym.Space[Any]:
    kind = description["type"]
    if kind == "discrete":
        return gym.spaces.Discrete(int(description["n"]), start=int(description.get("start", 0)))
    if kind == "multi_discrete":
        nvec, start = (np.array(description[key], np.int64) for key in ("nvec", "start"))
        dtype: Any = np.dtype(description.get("dtype", "int64")).type
        return gym.spaces.MultiDiscrete(nvec, start=start, dtype=dtype)
    if kind == "multi_binary":
        shape = _checked_shape(description)
        return gym.spaces.MultiBinary(shape if len(shape) != 1 else shape[0])
    if kind == "dict":
        # As pairs: Gymnasium sorts a dict's keys, and the space that is described may have them in another order.
        members = description["members"]
        return gym.spaces.Dict([(_key_from_json(key), _any_from_description(inner)) for key, inner in members])
    if kind == "tuple":
        return gym.spaces.Tuple([_any_from_description(inner) for inner in description["members"]])
    if kind == "box":
        dtype, shape = np.dtype(description["dtype"]), _checked_shape(description)
        low, high = (_bounds_from_json(description[key], shape, dtype) for key in ("low", "high"))
        box = gym.spaces.Box(low, high, shape, dtype.type)
        # What is drawn from it depends on these.
        box.bounded_below, box.bounded_above = is_bounded(box)
        return box
    raise ValueError(f"no space is of type {str(kind)[:80]!r}")


def unwritable_key(space: gym.Space[Any]) -> str | None:
    """Return how messages show a key of a Dict, also a nested one, that no JSON file can hold; None: it holds all."""
    for keys, _ in leaves(space, ()):
        for key in keys:
            if not _is_writable(key):
                return shortened(key)
    return None


def _is_writable(key: Any) -> bool:
    return all(map(_is_writable, key)) if isinstance(key, tuple) else isinstance(key, str | int | float | None)


def _key_from_json(key: Any) -> Any:
    return tuple(map(_key_from_json, key)) if isinstance(key, list) else key


def _checked_shape(description: Mapping[str, Any]) -> tuple[int, ...]:
    shape = tuple(int(size) for size in description["shape"])
    # Checked before an array of that size is made.
    if min(shape, default=0) < 0 or math.prod(shape) > MAX_SIZE:
        raise ValueError(f"its shape is {shape}")
    return shape


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
    if isinstance(value, list):
        return [_numbers_from_json(item) for item in value]
    # Whole numbers of 64 bits are more than floating-point ones hold.
    return value if isinstance(value, int) else float(value)

"""Make vectors of observations that are none: choices, dicts, tuples, matrices and whole numbers, also nested.

Networks take vectors of floating-point numbers and images. What else an environment observes is made one of these
where the environment is made, so that training, evaluation, videos and whoever asks a policy see the same:

* a choice (Discrete, each number of a MultiDiscrete) becomes as many numbers as there are choices, with a 1 at the
  place of the one that was made, and 0 elsewhere;
* a MultiBinary becomes its zeros and ones; a Box of any shape and dtype its numbers, as float32 and not scaled;
* a Dict and a Tuple become the numbers of their members, one after another, a Dict's in the order of Gymnasium's Dict;
* a picture of one channel, uint8 of shape (rows, columns), becomes (rows, columns, 1); one whose numbers are neither
  bytes nor floating-point becomes float32.

All but the last is what `gymnasium.spaces.flatten` does, which says less about an observation that does not fit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from policies.envs.byte_images import ByteImages, as_bytes
from policies.errors import shortened

MAX_SIZE = 10_000_000
"""The most numbers an observation may have: 25 times as many as four frames of an Atari screen."""
_IMAGE = 3


@dataclass(frozen=True)
class _Part:
    """A member of a space that has none itself, and where its numbers stand."""

    keys: tuple[Any, ...]
    space: gym.Space[Any]
    start: int
    end: int
    sizes: NDArray[np.int64]
    """How many values each choice has; empty: it is none."""
    lowest: NDArray[np.int64]
    """The lowest value of each choice."""
    offsets: NDArray[np.int64]
    """Where the numbers of each choice begin, counted from `start`."""


class UnsupportedMemberError(ValueError):
    """A space has a member of which no vector can be made; `place` and `space` say which."""

    def __init__(self, place: str, space: gym.Space[Any]) -> None:
        super().__init__(f"{place} is of kind {type(space).__name__} ({shortened(space)})")
        self.place, self.space = place, space


class FlatBox(gym.spaces.Box):
    """The vectors, or images, that observations of another space are made.

    Args:
        original: The environment's own space.

    Attributes:
        original: The same.

    Raises:
        UnsupportedMemberError: A member of the space is of a kind of which no vector can be made.
        ValueError: The vectors would have no numbers, or more than `MAX_SIZE`.
    """

    def __init__(self, original: gym.Space[Any]) -> None:
        self.original = original
        self._parts = parts = _parts_of(original)
        total = parts[-1].end if parts else 0
        if not 0 < total <= MAX_SIZE:
            raise ValueError(f"its observations have {total:,} numbers; from 1 to {MAX_SIZE:,} can be trained on")
        low, high = np.zeros(total, np.float32), np.ones(total, np.float32)
        # Bounds beyond what 32 bits hold are infinite there.
        with np.errstate(over="ignore"):
            for part in parts:
                if isinstance(part.space, gym.spaces.Box):
                    low[part.start : part.end] = part.space.low.ravel()
                    high[part.start : part.end] = part.space.high.ravel()
        shape, dtype = _shape_and_dtype(original, total)
        super().__init__(low.reshape(shape).astype(dtype), high.reshape(shape).astype(dtype), shape, dtype)

    def flat(self, observation: Any) -> NDArray[Any]:
        """Return the vector, or image, of one observation of the environment's own.

        Raises:
            ValueError: The observation is not of the space; the message says where, and fits behind "returns".
        """
        numbers = np.zeros(self._parts[-1].end, self.dtype)
        for part in self._parts:
            _write(numbers[part.start : part.end], part, _member(observation, part.keys))
        return numbers.reshape(self.shape)

    def flat_or_own(self, observations: Any) -> Any:
        """Return vectors: what is one, or a batch of them, as it is; one observation of the environment's own as one.

        A list of such observations, or an array of choices, is a batch; one of shape (1, n), if the environment's are
        of that shape, is an observation and not a batch of one vector.

        Raises:
            ValueError: It is neither.
        """
        if isinstance(self.original, gym.spaces.Discrete):
            values = np.asarray(observations)
            if values.dtype.kind not in "iu" or values.ndim > 1:
                return observations
            is_one = values.ndim == 0
        elif isinstance(self.original, gym.spaces.Dict | gym.spaces.Tuple):
            is_one = isinstance(observations, Mapping | tuple)
            first = observations[0] if isinstance(observations, list) and observations else None
            if not is_one and not isinstance(first, Mapping | tuple):
                return observations
        else:
            shape, own = np.shape(observations), self.original.shape or ()
            is_one = shape == own
            if self.shape in (own, shape) or not (is_one or shape[1:] == own):
                return observations
        return self.flat(observations) if is_one else self._batch(observations)

    def name_of(self, place: int) -> str:
        """Return how messages name what one of the numbers was made of: `observation['x'][0]`."""
        part = next(part for part in self._parts if place < part.end)
        # A number of a Box has a place of its own there; those of a choice are one value.
        shape = part.space.shape if isinstance(part.space, gym.spaces.Box | gym.spaces.MultiBinary) else ()
        where = np.unravel_index(place - part.start, shape) if shape else ()
        return named((*part.keys, *(int(index) for index in where)))

    def places(self) -> Iterator[tuple[tuple[Any, ...], gym.Space[Any], int, int]]:
        """Yield the members that have none themselves: their keys, spaces, and where their numbers begin and end."""
        for part in self._parts:
            yield part.keys, part.space, part.start, part.end

    def _batch(self, observations: Any) -> NDArray[Any]:
        return np.stack([self.flat(one) for one in observations])

    @override
    def __repr__(self) -> str:
        return f"{super().__repr__()} of {self.original}"


class FlatObservations(gym.ObservationWrapper[Any, Any, Any]):
    """Observe the vectors, or images, that a `FlatBox` makes."""

    def __init__(self, env: gym.Env[Any, Any], space: FlatBox) -> None:
        super().__init__(env)
        self.observation_space = self._space = space

    def observation(self, observation: Any) -> NDArray[Any]:
        """Return the vector, or image, of an observation.

        Raises:
            ValueError: The observation is not of the environment's space.
        """
        try:
            return self._space.flat(observation)
        except ValueError as error:
            raise ValueError(f"the environment returned {error}") from None


def needs_flattening(space: gym.Space[Any]) -> bool:
    """Whether a space is neither of vectors of floating-point numbers nor of images."""
    if not isinstance(space, gym.spaces.Box) or 0 in space.shape:
        return True
    is_float = np.issubdtype(space.dtype, np.floating)
    if len(space.shape) == _IMAGE:
        return not is_float and space.dtype != np.uint8
    return len(space.shape) != 1 or not is_float


def flattened(env: gym.Env[Any, Any]) -> Any:
    """Return an environment that observes vectors or images: itself if it does, or if none can be made.

    Images of bytes are of bytes then, whatever type of numbers the environment gives.
    """
    space = env.observation_space
    if not isinstance(space, gym.Space):
        return env
    if not needs_flattening(space):
        return ByteImages(env) if space.dtype == np.uint8 else env
    try:
        return FlatObservations(env, FlatBox(space))
    except ValueError:
        # Said by who checks the environment.
        return env


def leaves(space: gym.Space[Any], keys: tuple[Any, ...]) -> Iterator[tuple[tuple[Any, ...], gym.Space[Any]]]:
    """Yield the members of a space that have none themselves, each with the keys that lead to it."""
    if isinstance(space, gym.spaces.Dict):
        for key, inner in space.spaces.items():
            yield from leaves(inner, (*keys, key))
    elif isinstance(space, gym.spaces.Tuple):
        for index, inner in enumerate(space.spaces):
            yield from leaves(inner, (*keys, index))
    else:
        yield keys, space


def _parts_of(space: gym.Space[Any]) -> tuple[_Part, ...]:
    parts, end = list[_Part](), 0
    for keys, leaf in leaves(space, ()):
        sizes, lowest = np.zeros(0, np.int64), np.zeros(0, np.int64)
        if isinstance(leaf, gym.spaces.Discrete):
            sizes, lowest = np.array([leaf.n], np.int64), np.array([leaf.start], np.int64)
        elif isinstance(leaf, gym.spaces.MultiDiscrete):
            sizes, lowest = (values.ravel().astype(np.int64) for values in (leaf.nvec, leaf.start))
        elif not isinstance(leaf, gym.spaces.Box | gym.spaces.MultiBinary):
            raise UnsupportedMemberError(named(keys), leaf)
        size = int(sizes.sum()) if sizes.size else math.prod(leaf.shape or ())
        parts.append(_Part(keys, leaf, end, end := end + size, sizes, lowest, np.cumsum(sizes) - sizes))
    return tuple(parts)


def _shape_and_dtype(original: gym.Space[Any], total: int) -> tuple[tuple[int, ...], Any]:
    if isinstance(original, gym.spaces.Box):
        if len(original.shape) == _IMAGE:
            return original.shape, np.float32
        if len(original.shape) == _IMAGE - 1 and original.dtype == np.uint8:
            return (*original.shape, 1), np.uint8
    return (total,), np.float32


def named(keys: tuple[Any, ...], what: str = "observation") -> str:
    """Return how messages name a member: `observation['a'][0]`."""
    return what + "".join(f"[{key!r}]" for key in keys)


def _member(observation: Any, keys: tuple[Any, ...]) -> Any:
    """Return the member of an observation that some keys lead to.

    Raises:
        ValueError: There is none.
    """
    value = observation
    for depth, key in enumerate(keys):
        try:
            value = value[key]
        except (KeyError, IndexError, TypeError):
            kind = "tuple" if isinstance(key, int) else "dict"
            what = f"with no member {key!r}" if isinstance(value, Mapping | tuple | list) else f"that is no {kind}"
            raise ValueError(f"{shortened(value)} as {named(keys[:depth])}, {what}") from None
    return value


def _write(numbers: NDArray[Any], part: _Part, value: Any) -> None:
    """Write the numbers of one member, all zero so far.

    Raises:
        ValueError: The value is not of its space, or of bytes and one of its numbers is none.
    """
    if problem := _written(numbers, part, value):
        raise ValueError(f"{shortened(value)} as {named(part.keys)}, {problem}")


def _written(numbers: NDArray[Any], part: _Part, value: Any) -> str:
    """Write them; return what is wrong with the value, as words behind it, or nothing; of bytes see `as_bytes`."""
    try:
        array = np.asarray(value)
    except Exception:  # noqa: BLE001 (ragged lists, say)
        array = np.empty(0, dtype=object)
    shape = part.space.shape or ()
    # A number alone may come as an array of one, and one of those as a number alone.
    if array.dtype.kind not in "biuf" or not (array.shape == shape or array.size == math.prod(shape) == 1):
        return f"not numbers of shape {shape}" if shape else "not a number"
    if isinstance(part.space, gym.spaces.Box):
        with np.errstate(over="ignore"):
            numbers[:] = (as_bytes(array) if numbers.dtype == np.uint8 else array).ravel()
        return ""
    if array.dtype.kind not in "biu":
        return "not whole numbers"
    if part.sizes.size == 0:
        numbers[:] = array.ravel()
        return "" if ((array == 0) | (array == 1)).all() else "not zeros and ones"
    choices = array.ravel().astype(np.int64) - part.lowest
    if not ((choices >= 0) & (choices < part.sizes)).all():
        return f"which is outside of {part.space}"
    numbers[part.offsets + choices] = 1.0
    return ""

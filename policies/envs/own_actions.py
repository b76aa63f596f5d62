"""Take actions as networks give them: a number, several choices, or a vector, whatever the environment's own form is.

PPO draws three kinds of actions: one choice (Discrete), several at once (a MultiDiscrete of one dimension that counts
from 0), and vectors of floating-point numbers. What else an environment takes is made one of these where the
environment is made, so that training, evaluation and videos send the same, and `Policy.act` turns them back:

* a MultiDiscrete of any shape and start, a MultiBinary, and a Dict or Tuple of choices, nested as it may be: `Choices`;
* a Box of another shape, or of whole numbers, and a Dict or Tuple of Boxes: `Numbers`. Whole numbers are rounded.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeGuard

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from policies.envs.flat import MAX_SIZE, leaves, named
from policies.errors import shortened

_ACTION = "action"


class UnsupportedActionsError(ValueError):
    """No policy gives actions of a space; the message says why, and fits behind "actions"."""


class Choices(gym.spaces.MultiDiscrete):
    """Several choices at once, each counted from 0, that an environment's own actions are made of.

    Args:
        original: The environment's own space.

    Attributes:
        original: The same.
        sizes: How many values each choice has.

    Raises:
        UnsupportedActionsError: A member of the space is no choice, or there are none or too many.
    """

    def __init__(self, original: gym.Space[Any]) -> None:
        self.original = original
        self._parts = [(keys, space, _sizes_of(space, keys)) for keys, space in leaves(original, ())]
        self.sizes = tuple(size for *_, sizes in self._parts for size in sizes)
        _check_total(sum(self.sizes), original)
        super().__init__(np.array(self.sizes, np.int64))

    def own(self, choices: NDArray[Any]) -> Any:
        """Return an action as the environment takes it."""
        values, start = [], 0
        for _, space, sizes in self._parts:
            values.append(_own_choices(space, choices[start : start + len(sizes)]))
            start += len(sizes)
        return _nested(self.original, values)

    def given_for(self, own: Any) -> NDArray[np.int64]:
        """Return what a policy gives for an action as the environment takes it; the inverse of `own`."""
        starts = [np.ravel(getattr(space, "start", 0)) for _, space, _ in self._parts]
        values = [np.ravel(_member(own, keys)) - start for (keys, *_), start in zip(self._parts, starts, strict=True)]
        return np.concatenate(values).astype(np.int64)

    @override
    def __repr__(self) -> str:
        return repr(self.original)


class Numbers(gym.spaces.Box):
    """Vectors of floating-point numbers that an environment's own actions are made of.

    Args:
        original: The environment's own space.

    Attributes:
        original: A copy of it, whose whole numbers have the bounds of `is_bounded`.

    Raises:
        UnsupportedActionsError: A member of the space is no Box, or there are no numbers or too many.
    """

    def __init__(self, original: gym.Space[Any]) -> None:
        self.original = copy.deepcopy(original)
        boxes = [space for _, space in leaves(self.original, ())]
        self._boxes = [space for space in boxes if isinstance(space, gym.spaces.Box)]
        sizes = [math.prod(space.shape) for space in self._boxes]
        if len(boxes) != len(sizes):
            raise UnsupportedActionsError(f"{shortened(original)}, which are not only numbers")
        _check_total(sum(sizes), original)
        whole = [space for space in self._boxes if not np.issubdtype(space.dtype, np.floating)]
        self._has_whole = bool(whole)
        for space in whole:
            # A Box draws by these, and can't between written-out bounds that are the largest of their type.
            space.bounded_below, space.bounded_above = is_bounded(space)
        floats = [space.dtype for space in self._boxes if np.issubdtype(space.dtype, np.floating)]
        dtype = np.result_type(np.float32, *floats)
        with np.errstate(over="ignore"):
            low, high = (
                np.concatenate([bound.ravel().astype(dtype) for bound in sides])
                for sides in zip(*map(_bounds, self._boxes), strict=True)
            )
        super().__init__(low, high, dtype=dtype.type)

    @override
    def seed(self, seed: Any = None) -> Any:
        """Seed the random numbers, those of the original where it draws."""
        if self._has_whole:
            self.original.seed(seed)
        return super().seed(seed)

    @override
    def sample(self, mask: None = None, probability: None = None) -> NDArray[Any]:
        """Draw numbers as the original does where some are whole: rounded ones would be at the bounds half as often."""
        if self._has_whole:
            return self.given_for(self.original.sample())
        return super().sample(mask, probability)

    def own(self, numbers: NDArray[Any]) -> Any:
        """Return an action as the environment takes it."""
        values, start = [], 0
        for space in self._boxes:
            stop = start + math.prod(space.shape)
            values.append(_own_numbers(space, numbers[start:stop].reshape(space.shape)))
            start = stop
        return _nested(self.original, values)

    def given_for(self, own: Any) -> NDArray[Any]:
        """Return what a policy gives for an action as the environment takes it; the inverse of `own`."""
        numbers = [np.ravel(_member(own, keys)) for keys, _ in leaves(self.original, ())]
        return np.concatenate(numbers).astype(self.dtype)

    @override
    def __repr__(self) -> str:
        return repr(self.original)


Made: TypeAlias = Choices | Numbers


@dataclass(frozen=True)
class _OwnAction:
    """An action that is in the environment's own form already."""

    value: Any


class TakesActions(gym.ActionWrapper[Any, Any, Any]):
    """Takes the actions of `Choices` or `Numbers`."""

    def __init__(self, env: gym.Env[Any, Any], space: Made) -> None:
        super().__init__(env)
        self.action_space = self._space = space

    def action(self, action: Any) -> Any:
        """Return an action as the environment takes it."""
        return action.value if isinstance(action, _OwnAction) else self._space.own(np.asarray(action))


class TakesOwnActions(gym.ActionWrapper[Any, Any, Any]):
    """Takes actions in the environment's own form, as `Policy.act` gives them, around all other wrappers."""

    def __init__(self, env: gym.Env[Any, Any], original: gym.Space[Any]) -> None:
        super().__init__(env)
        self.action_space = copy.deepcopy(original)

    def action(self, action: Any) -> Any:
        """Return an action that `TakesActions` leaves as it is."""
        return _OwnAction(action)


def is_taken(space: gym.Space[Any]) -> bool:
    """Whether policies give actions of a space as they are."""
    if isinstance(space, gym.spaces.Discrete) or is_made(space):
        return True
    return (
        isinstance(space, gym.spaces.Box)
        and len(space.shape) == 1
        and space.shape[0] > 0
        and np.issubdtype(space.dtype, np.floating)
    )


def is_made(space: gym.Space[Any]) -> TypeGuard[Made]:
    """Whether actions of a space are made the environment's own."""
    return isinstance(space, Choices | Numbers)


def made_of(space: gym.Space[Any]) -> Made:
    """Return what policies give for an environment's actions.

    Raises:
        UnsupportedActionsError: They can't give such actions.
    """
    kinds = [space for _, space in leaves(space, ())]
    if kinds and all(isinstance(kind, gym.spaces.Box) for kind in kinds):
        return Numbers(space)
    return Choices(space)


def with_own_actions(env: gym.Env[Any, Any]) -> Any:
    """Return an environment that takes what policies give: itself if it does, or if they can't give such actions."""
    space = env.action_space
    if not isinstance(space, gym.Space) or is_taken(space):
        return env
    try:
        return TakesActions(env, made_of(copy.deepcopy(space)))
    except UnsupportedActionsError:
        # Said by who checks the environment.
        return env


def sizes_of(space: gym.Space[Any]) -> tuple[int, ...]:
    """Return how many values each choice of an action has; empty if actions are no choices."""
    if isinstance(space, gym.spaces.Discrete):
        return (int(space.n),)
    return space.sizes if isinstance(space, Choices) else ()


def own_actions(space: gym.Space[Any], actions: NDArray[Any]) -> Any:
    """Return a batch of actions as the environment takes them: an array, or a list of dicts or tuples."""
    if not is_made(space):
        return actions
    each = [space.own(action) for action in actions]
    if isinstance(space.original, gym.spaces.Dict | gym.spaces.Tuple):
        return each
    return np.array(each).reshape(len(each), *(space.original.shape or ()))


def is_bounded(space: gym.spaces.Box) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where a Box has lower bounds, and where upper ones, by their values, which are all that files have.

    Gymnasium writes infinite bounds of whole numbers as the least and the largest that their type holds, asks whoever
    writes them for one less, and draws nothing beyond two less. Of few bits those are taken for bounds, as of bytes,
    and so are those of numbers without a sign, which it lets nobody leave out.
    """
    if space.dtype in (np.int32, np.int64):
        most = np.iinfo(space.dtype)
        return space.low > most.min + 2, space.high < most.max - 2
    return space.low > -np.inf, space.high < np.inf


def _bounds(space: gym.spaces.Box) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the bounds of a Box, infinite where it has none."""
    below, above = is_bounded(space)
    return np.where(below, space.low, -np.inf), np.where(above, space.high, np.inf)


def _check_total(total: int, original: gym.Space[Any]) -> None:
    if not 0 < total <= MAX_SIZE:
        raise UnsupportedActionsError(f"{shortened(original)}, of {total:,} numbers; from 1 to {MAX_SIZE:,} can be")


def _sizes_of(space: gym.Space[Any], keys: tuple[Any, ...]) -> tuple[int, ...]:
    if isinstance(space, gym.spaces.Discrete):
        return (int(space.n),)
    if isinstance(space, gym.spaces.MultiDiscrete):
        return tuple(int(size) for size in space.nvec.ravel())
    if isinstance(space, gym.spaces.MultiBinary):
        return (2,) * math.prod(space.shape)
    what = "numbers beside choices" if isinstance(space, gym.spaces.Box) else "neither choices nor numbers"
    place = f"{named(keys, _ACTION)} is of kind {type(space).__name__}"
    raise UnsupportedActionsError(f"whose {place} ({shortened(space)}), {what}")


def _own_choices(space: gym.Space[Any], choices: NDArray[Any]) -> Any:
    if isinstance(space, gym.spaces.Discrete):
        # A plain number: NumPy's fail `isinstance(action, int)` in some envs.
        return int(choices[0]) + int(space.start)
    shaped = choices.reshape(space.shape)
    if isinstance(space, gym.spaces.MultiDiscrete):
        shaped = shaped + space.start
    return shaped.astype(space.dtype)


def _own_numbers(space: gym.spaces.Box, numbers: NDArray[Any]) -> NDArray[Any]:
    if np.issubdtype(space.dtype, np.floating):
        clipped: NDArray[Any] = np.clip(numbers, space.low, space.high).astype(space.dtype)
        return clipped
    rounded = np.rint(numbers.astype(np.float64))
    inside = (rounded > space.low.astype(np.float64)) & (rounded < space.high.astype(np.float64))
    # The bounds themselves may be whole numbers that no floating-point number equals.
    own: NDArray[Any] = np.where(rounded < 0.5 * space.low + 0.5 * space.high, space.low, space.high)
    own[inside] = rounded[inside].astype(space.dtype)
    return own.astype(space.dtype)


def _member(own: Any, keys: tuple[Any, ...]) -> Any:
    for key in keys:
        own = own[key]
    return own


def _nested(space: gym.Space[Any], values: Sequence[Any]) -> Any:
    """Return values as members of a space; they are in the order of its leaves."""
    found = iter(values)

    def build(part: gym.Space[Any]) -> Any:
        if isinstance(part, gym.spaces.Dict):
            return {key: build(inner) for key, inner in part.spaces.items()}
        if isinstance(part, gym.spaces.Tuple):
            return tuple(build(inner) for inner in part.spaces)
        return next(found)

    return build(space)

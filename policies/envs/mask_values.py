"""What a mask of actions is: zeros and ones, one for each value of each choice, with something allowed of each."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from policies.errors import shortened


class MaskProblemError(ValueError):
    """A value is no mask; the message fits behind the value."""


def checked_mask(mask: Any, sizes: tuple[int, ...]) -> NDArray[np.float32]:
    """Return a mask as a vector of zeros and ones.

    Args:
        mask: Zeros and ones, or false and true, in any shape; or one such array for each choice.
        sizes: How many values each choice has.

    Raises:
        MaskProblemError: It is something else, or a choice has no value that is allowed.
    """
    num = sum(sizes)
    if isinstance(mask, np.ndarray):
        values = mask.reshape(-1)
    else:
        try:
            parts = mask if isinstance(mask, tuple | list) else [mask]
            values = np.concatenate([np.asarray(part).reshape(-1) for part in parts])
        except ValueError:
            values = np.empty(0, dtype=object)
    if values.dtype.kind not in "biuf" or values.size != num:
        raise MaskProblemError(f"not {num} zeros and ones, one for each action{_if_numbers(values, sizes)}")
    if not ((values == 0) | (values == 1)).all():
        raise MaskProblemError(f"not zeros and ones{_if_numbers(values, sizes)}")
    checked = values.astype(np.float32)
    if len(sizes) == 1:
        if not checked.any():
            raise MaskProblemError("which forbids every action")
        return checked
    allowed = np.add.reduceat(checked, _starts(sizes))
    if not allowed.all():
        number = int(np.flatnonzero(allowed == 0)[0])
        raise MaskProblemError(f"which forbids every value of choice {number}, counted from 0")
    return checked


def check_masks(masks: NDArray[Any], sizes: tuple[int, ...]) -> None:
    """Check masks that are in vectors of numbers already, shape (..., numbers of a mask).

    Raises:
        ValueError: One is none; the message shows the first.
    """
    rows = masks.reshape(-1, masks.shape[-1])
    if ((rows == 0) | (rows == 1)).all() and np.logical_or.reduceat(rows, _starts(sizes), axis=1).all():
        return
    for row in rows:
        try:
            checked_mask(row, sizes)
        except MaskProblemError as error:
            raise ValueError(f"{shortened(row.tolist())} is the mask, {error}") from None


def listed_mask(actions: Any, size: int, first: int) -> NDArray[np.float32]:
    """Return the mask for a list of the actions that are allowed.

    Args:
        actions: Whole numbers in any order: a list, a tuple, a set, an array, or the keys of a mapping.
        size: How many actions there are.
        first: The number of the first.

    Raises:
        MaskProblemError: It is something else, or empty.
    """
    try:
        numbers = np.asarray(list(actions))
    except (TypeError, ValueError):  # nothing to go through, or members of several shapes
        numbers = np.empty((0, 0))
    if numbers.shape == (0,):
        raise MaskProblemError("which forbids every action")
    if numbers.ndim != 1 or numbers.dtype.kind not in "iu":
        raise MaskProblemError(f"not a list of actions, which are numbers from {first} to {first + size - 1}")
    # Small numbers of another start may overflow otherwise.
    numbers = numbers.astype(np.int64)
    outside = numbers[(numbers < first) | (numbers >= first + size)]
    if outside.size:
        raise MaskProblemError(f"and {outside[0]} is no action: they are numbers from {first} to {first + size - 1}")
    listed = set(numbers.tolist())
    if numbers.size == size > len(listed) and listed <= {0, 1}:
        raise MaskProblemError("which are zeros and ones and not a list of actions: give its name alone for a mask")
    mask = np.zeros(size, np.float32)
    mask[numbers - first] = 1
    return mask


def _if_numbers(values: NDArray[Any], sizes: tuple[int, ...]) -> str:
    """Return what to do if what was given for a mask are the actions allowed, themselves; "": they are not."""
    if len(sizes) > 1 or values.dtype.kind not in "iu" or len(set(values.tolist())) != values.size:
        return ""
    if not ((values >= 0) & (values < sizes[0])).all():
        return ""
    return (
        "; if these are the actions that are allowed, write action_mask: {actions: ...} with its name, or make zeros "
        "and ones of them"
    )


@functools.cache
def _starts(sizes: tuple[int, ...]) -> NDArray[np.int64]:
    """Return where each choice begins in a mask."""
    return np.cumsum((0, *sizes[:-1]))


def is_one_mask(mask: Any) -> bool:
    """Whether something is numbers of one mask, and not several masks."""
    try:
        values = np.asarray(mask)
    except ValueError:  # ragged lists, as of several choices
        return False
    return values.ndim < 2 and values.size > 0 and values.dtype.kind in "biuf"

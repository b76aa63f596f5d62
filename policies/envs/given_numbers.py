"""Take what somebody gives a policy to act on as numbers.

An array of 32 bits takes more than numbers without a word: None becomes NaN, text is read, and complex numbers lose
their imaginary part.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from policies.envs.byte_images import as_bytes
from policies.errors import shortened

_TEXT = (str, bytes)


def numbers_of(given: ArrayLike, space: gym.Space[Any]) -> NDArray[Any]:
    """Return what is given as numbers, of any shape; as bytes where the space is of bytes.

    Raises:
        ValueError: They are no numbers, or no bytes; the message says what is wrong.
        TypeError: NumPy can't make numbers of them.
        OverflowError: A number is too large for any of NumPy's.
    """
    array = np.asarray(given)
    if space.dtype == np.uint8:
        return as_bytes(array)
    if array.dtype.kind in "biuf":
        return array
    if array.dtype.kind != "O":
        raise ValueError(f"there are values of dtype {array.dtype}")
    # Fractions, say, are numbers; it is None and text that NumPy should not make numbers of.
    for item in array.flat:
        if item is None or isinstance(item, _TEXT):
            raise ValueError(f"there is {shortened(item)}")
    return array.astype(np.float64)

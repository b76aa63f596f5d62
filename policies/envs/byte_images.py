"""Observe images of bytes as bytes, whatever the type of the numbers that an environment gives.

Arrays of bytes take any number without a word: of 0.99 they keep 0, of -1 255.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray


def as_bytes(numbers: NDArray[Any]) -> NDArray[np.uint8]:
    """Return numbers as bytes; what is of bytes already, as it is.

    Raises:
        ValueError: They are no numbers, or one is no byte; the message fits behind "returns".
    """
    if numbers.dtype == np.uint8:
        return numbers
    if numbers.dtype.kind not in "biuf":
        raise ValueError(f"an observation of dtype {numbers.dtype}, not of bytes")
    with np.errstate(invalid="ignore"):  # NaN, and what is too large
        made = numbers.astype(np.uint8)
    same = made == numbers
    if same.all():
        return made
    wrong = numbers[~same].flat[0].item()
    raise ValueError(f"an observation in which {wrong!r} is no byte, a whole number from 0 to 255")


class ByteImages(gym.ObservationWrapper[Any, Any, Any]):
    """Observes images of bytes, or refuses what is none."""

    def observation(self, observation: Any) -> Any:
        """Return the image as bytes; what are no numbers as it is, for those who check what environments return.

        Raises:
            ValueError: A number in it is no byte.
        """
        if isinstance(observation, np.ndarray) and observation.dtype == np.uint8:
            return observation
        try:
            array = np.asarray(observation)
        except Exception:  # noqa: BLE001 (ragged lists, say)
            return observation
        if array.dtype.kind not in "biuf":
            return observation
        try:
            return as_bytes(array)
        except ValueError as error:
            raise ValueError(f"the environment returned {error}") from None

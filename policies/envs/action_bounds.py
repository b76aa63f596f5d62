"""Turn a policy's continuous actions into actions within the bounds of a Box, each component by its own bounds.

A policy of Box actions gives numbers around 0. A component with two bounds is stretched, [-1, 1] over its bounds, and
clipped to them; one with a single bound is clipped to it, as there is nothing to stretch over; one with none stays as
it is. Both engines and portable policies use this one function: RLlib's own `unsquash_action` (2.60) leaves all
components as they are if one bound of one of them is infinite, or if their precision is neither 32 nor 64 bits.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray


class ToBounds:
    """Turns a policy's actions, shape (..., components), into actions of a Box.

    Args:
        space: The action space.
    """

    def __init__(self, space: gym.spaces.Box) -> None:
        self._low, self._high, self._dtype = space.low, space.high, space.low.dtype
        with np.errstate(over="ignore", invalid="ignore"):
            # Bounds that are the largest numbers of the format count as none: nothing can be stretched over them.
            stretches = space.bounded_below & space.bounded_above & np.isfinite(space.high - space.low)
        self.stretches_all = bool(stretches.all())
        """Whether every component has two bounds."""
        self._stretches = stretches
        # The other components get harmless values here; their results are not used.
        self._from = np.where(stretches, space.low, np.zeros_like(space.low))
        self._to = np.where(stretches, space.high, np.zeros_like(space.high))

    def __call__(self, actions: NDArray[Any]) -> NDArray[Any]:
        """Return the actions within the bounds, in the Box's own precision."""
        # RLlib's operations in RLlib's order: where RLlib stretches, the result is the same to the bit.
        stretched: NDArray[Any] = self._from + (actions + 1.0) * (self._to - self._from) / 2.0
        if not self.stretches_all:
            stretched = np.where(self._stretches, stretched, actions)
        clipped: NDArray[Any] = np.clip(stretched, self._low, self._high).astype(self._dtype)
        return clipped

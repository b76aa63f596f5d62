"""The vectors of several observations at once, each of which has members: where each member's numbers are."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np

from policies.envs.flat import FlatBox


class StackedBox(gym.spaces.Box):
    """The vectors of the last observations of a kind, oldest first.

    Args:
        frame: Those of one observation.
        num_frames: How many there are.

    Attributes:
        frame, num_frames: The same.
    """

    def __init__(self, frame: FlatBox, num_frames: int) -> None:
        self.frame, self.num_frames = frame, num_frames
        low, high = (np.concatenate([bound] * num_frames) for bound in (frame.low, frame.high))
        super().__init__(low, high, dtype=np.float32)

    def name_of(self, place: int) -> str:
        """Return how messages name what one of the numbers was made of, whichever observation it is of."""
        return self.frame.name_of(place % self.frame.shape[0])

    def places(self) -> Iterator[tuple[tuple[Any, ...], gym.Space[Any], int, int]]:
        """Yield the members of each observation: their keys, spaces, and where their numbers begin and end."""
        for number in range(self.num_frames):
            before = number * self.frame.shape[0]
            for keys, space, start, end in self.frame.places():
                yield keys, space, before + start, before + end


WithMembers = FlatBox | StackedBox
"""The spaces that know of which members their numbers are."""

"""Which of the numbers that networks see of an observation are an image, over which convolutions can go.

An observation is an image as a whole, or the vector that `policies.envs.flat` makes of several members, one of which is
an image. The rest of a vector goes into the dense layers, beside what the convolutions make of the image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from policies.envs.flat import FlatBox
from policies.envs.masks import seen_by_networks

_IMAGE = 3
"""The dimensions of an image."""


@dataclass(frozen=True)
class SeenImage:
    """An image among the numbers that networks see of an observation."""

    shape: tuple[int, int, int]
    """(height, width, channels)."""
    start: int = 0
    """The place of its first number in the vector."""
    num_beside: int = 0
    """The numbers of the vector that are not the image's."""
    scale: float = 1.0
    """What its numbers are multiplied by before the convolutions."""

    @property
    def stop(self) -> int:
        """The place after its last number."""
        return self.start + math.prod(self.shape)

    @property
    def num_seen(self) -> int:
        """All numbers of the vector."""
        return math.prod(self.shape) + self.num_beside


def image_seen(space: gym.Space[Any]) -> SeenImage | None:
    """Return what convolutions can see of an environment's observations; None: no image, or several."""
    shape = seen_by_networks(space).shape or ()
    if len(shape) == _IMAGE:
        height, width, channels = (int(size) for size in shape)
        return SeenImage((height, width, channels))
    return image_member(space)


def image_member(space: gym.Space[Any], *, normalizes: bool = False) -> SeenImage | None:
    """Return the only image among the members of which a vector is made; None: there is none, or several.

    Args:
        space: What an environment observes, with its mask.
        normalizes: Whether vectors are normalised, so that bytes need not be scaled.
    """
    images = image_members(space)
    if len(images) != 1:
        return None
    seen = seen_by_networks(space)
    assert isinstance(seen, FlatBox)
    ((keys, shape),) = images.items()
    leaf, start = next((leaf, start) for found, leaf, start, _ in seen.places() if found == keys)
    num_beside = math.prod(seen.shape) - math.prod(shape)
    return SeenImage(shape, start, num_beside, 1.0 if normalizes else scale_of_bytes(leaf))


def image_members(space: gym.Space[Any]) -> dict[tuple[Any, ...], tuple[int, int, int]]:
    """Return the members that are images, by the keys that lead to them, and their shapes; a whole image is no member.

    An image is a Box of three dimensions, or bytes in two, which are one channel.
    """
    seen = seen_by_networks(space)
    if not isinstance(seen, FlatBox) or len(seen.shape) != 1:
        return {}
    found = {}
    for keys, leaf, _, _ in seen.places():
        if not keys or not isinstance(leaf, gym.spaces.Box):
            continue
        shape = (*leaf.shape, 1) if leaf.dtype == np.uint8 and len(leaf.shape) == _IMAGE - 1 else leaf.shape
        if len(shape) == _IMAGE:
            height, width, channels = (int(size) for size in shape)
            found[keys] = (height, width, channels)
    return found


def scale_of_bytes(space: gym.Space[Any]) -> float:
    """Return the factor that makes the bytes of a space numbers of 0 to 1; 1 for what is not of bytes.

    It is 1 over the largest number that the space has: 1/255 of pixels, 1 of a board's zeros and ones.
    """
    if not isinstance(space, gym.spaces.Box) or space.dtype != np.uint8:
        return 1.0
    return 1.0 / max(1.0, float(space.high.max()))

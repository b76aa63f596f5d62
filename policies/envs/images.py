"""Which of the numbers that networks see of an observation are an image, over which convolutions can go.

An observation is an image as a whole, or the vector that `policies.envs.flat` makes of several members, some of which
are images of one height and width: those are the channels of one image, as those of the last observations are where
several are seen at once. The rest of a vector goes into the dense layers, beside what the convolutions make of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar, cast

import gymnasium as gym
import numpy as np

from policies.envs.masks import seen_by_networks
from policies.envs.stacked import WithMembers

_IMAGE = 3
"""The dimensions of an image."""


Rows = TypeVar("Rows")
"""NumPy's arrays, or torch's tensors, which are not known here: portable policies do without."""


@dataclass(frozen=True)
class Channels:
    """Channels of an image that lie together among the numbers of a vector: those of one member."""

    start: int
    """The place of their first number in the vector."""
    num_channels: int
    scale: float = 1.0
    """What their numbers are multiplied by before the convolutions."""


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
    """What its numbers are multiplied by before the convolutions; of several members, those of the first."""
    more: tuple[Channels, ...] = ()
    """The other members whose channels are the image's; `shape` counts them. They lie behind the first one."""

    @property
    def num_seen(self) -> int:
        """All numbers of the vector."""
        return math.prod(self.shape) + self.num_beside

    @property
    def unscaled(self) -> SeenImage:
        """The same with numbers that are not multiplied by anything."""
        return replace(self, scale=1.0, more=tuple(replace(each, scale=1.0) for each in self.more))

    @cached_property
    def parts(self) -> tuple[Channels, ...]:
        """The channels of each member, in the order in which they lie in the vector and are the image's."""
        num_first = self.shape[2] - sum(each.num_channels for each in self.more)
        return Channels(self.start, num_first, self.scale), *self.more

    @cached_property
    def places(self) -> tuple[slice, ...]:
        """The numbers of each of `parts`."""
        size = self.shape[0] * self.shape[1]
        return tuple(slice(each.start, each.start + size * each.num_channels) for each in self.parts)

    @cached_property
    def places_beside(self) -> tuple[slice, ...]:
        """The numbers that are not the image's."""
        starts = [0, *(place.stop for place in self.places)]
        stops = [*(place.start for place in self.places), self.num_seen]
        return tuple(slice(start, stop) for start, stop in zip(starts, stops, strict=True) if start < stop)

    def members_of(self, rows: Rows) -> list[Rows]:
        """Return the image of each of `parts`, (..., height, width, channels), scaled, of vectors, (..., numbers)."""
        array, found = cast("Any", rows), []
        for part, place in zip(self.parts, self.places, strict=True):
            image = array[..., place].reshape(*array.shape[:-1], *self.shape[:2], part.num_channels)
            found.append(image if part.scale == 1.0 else image * part.scale)
        return found

    def beside_of(self, rows: Rows) -> list[Rows]:
        """Return the numbers beside the image, in parts; empty: there are none."""
        return [cast("Any", rows)[..., place] for place in self.places_beside]


def image_seen(space: gym.Space[Any]) -> SeenImage | None:
    """Return what convolutions can see of an environment's observations; None: no image, or several of other sizes."""
    shape = seen_by_networks(space).shape or ()
    if len(shape) == _IMAGE:
        height, width, channels = (int(size) for size in shape)
        return SeenImage((height, width, channels))
    return image_member(space)


def image_member(space: gym.Space[Any], *, normalizes: bool = False) -> SeenImage | None:
    """Return the image that members of a vector make; None: none is an image, or they are of different sizes.

    Images of one height and width are the channels of one, as color and depth are, or planes of a board.

    Args:
        space: What an environment observes, with its mask.
        normalizes: Whether vectors are normalised, so that bytes need not be scaled.
    """
    images = image_members(space)
    sizes = {(height, width) for height, width, _ in images.values()}
    if len(sizes) != 1:
        return None
    seen = seen_by_networks(space)
    assert isinstance(seen, WithMembers)
    first, *more = (
        Channels(start, images[keys][2], scale_of_bytes(leaf))
        for keys, leaf, start, _ in seen.places()
        if keys in images
    )
    ((height, width),) = sizes
    shape = height, width, first.num_channels + sum(each.num_channels for each in more)
    num_beside = math.prod(seen.shape) - math.prod(shape)
    image = SeenImage(shape, first.start, num_beside, first.scale, tuple(more))
    return image.unscaled if normalizes else image


def image_members(space: gym.Space[Any]) -> dict[tuple[Any, ...], tuple[int, int, int]]:
    """Return the members that are images, by the keys that lead to them, and their shapes; a whole image is no member.

    Where several observations are seen at once, a member has as many images of that shape.

    An image is a Box of three dimensions, or bytes in two, which are one channel.
    """
    seen = seen_by_networks(space)
    if not isinstance(seen, WithMembers) or len(seen.shape) != 1:
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

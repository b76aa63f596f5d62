"""Say what a stack's networks see of an observation, and hold images of bytes in rows of floating-point numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from policies.envs.images import SeenImage, image_seen
from policies.envs.masks import num_masked, seen_by_networks
from policies.envs.spaces import observation_dtype
from policies.networks.layers import observation_scale

Floats = NDArray[np.float32]
_BYTES_PER_COLUMN = 4


@dataclass(frozen=True)
class Inputs:
    """What networks see of an observation. A stack has all observations as rows: images by row, column and channel."""

    shape: tuple[int, ...]
    """The shape of what they see: (n,), or (height, width, channels)."""
    dtype: type[np.uint8 | np.float32]
    """The dtype of observations; bytes are images. Those of images behind a mask are floating-point numbers."""
    scale: float = 1.0
    """What observations are multiplied by first."""
    num_masked: int = 0
    """The numbers of a mask of actions, with which an observation begins."""
    image: SeenImage | None = None
    """The image over which convolutions go, if a network has some."""

    @classmethod
    def of(cls, space: gym.Space[Any]) -> Self:
        """Return what networks see of observations of a space."""
        shape = tuple(seen_by_networks(space).shape or ())
        scale = observation_scale(space)
        return cls(shape, observation_dtype(space), scale, num_masked(space), image_seen(space))

    @classmethod
    def vector(cls, num_inputs: int, num_masked: int = 0) -> Self:
        """Return the same of vectors."""
        return cls((num_inputs,), np.float32, num_masked=num_masked)

    @property
    def unmasked(self) -> Self:
        """The same without the mask."""
        return replace(self, num_masked=0)

    @cached_property
    def num_inputs(self) -> int:
        """The numbers of an observation that networks see."""
        return math.prod(self.shape)

    @cached_property
    def num_observed(self) -> int:
        """The numbers of an observation, with its mask."""
        return self.num_masked + self.num_inputs

    @property
    def is_image(self) -> bool:
        """Whether observations are images as a whole."""
        return len(self.shape) > 1

    @cached_property
    def is_bytes(self) -> bool:
        """Whether observations are images of bytes."""
        return self.dtype == np.uint8

    @cached_property
    def num_columns(self) -> int:
        """The columns of an observation in a row of floating-point numbers: four bytes in one, or one more for a 1.

        The 1 is multiplied by the first bias of `StackedNetworks`.
        """
        return -(-self.num_inputs // _BYTES_PER_COLUMN) if self.is_bytes else self.num_observed + 1

    def put(self, columns: Floats, observations: NDArray[Any]) -> None:
        """Write observations, (..., numbers), into their columns, (..., num_columns)."""
        if self.is_bytes:
            columns.view(np.uint8)[..., : self.num_inputs] = observations
        else:
            columns[..., : self.num_observed] = observations
            columns[..., self.num_observed] = 1.0

    def bytes_in(self, columns: Floats) -> NDArray[np.uint8]:
        """Return the bytes of observations, (..., D), that `put` wrote into columns."""
        return columns.view(np.uint8)[..., : self.num_inputs]

    def bytes_in_tensor(self, columns: Tensor) -> Tensor:
        """Return the same of a tensor."""
        return columns.view(torch.uint8)[..., : self.num_inputs]

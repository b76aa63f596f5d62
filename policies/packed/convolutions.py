"""Convolutions of many small networks at once: products of the windows that a kernel sees, in batches over networks.

Shapes: K networks, B images per network, P places of a kernel in an image, D numbers of an image, W numbers of a
window, F filters. An image is a row of numbers in the order row, column, channel, as environments return them, and so
is what a convolution makes of it: each place's filters side by side. The numbers of a window are in the same order.

Each network's product is one of its own, whose shape the others have no part in. Calls of a grouped convolution would
save the copies of the windows, but take longer at the sizes of updates (decision 49).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
import torch
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray
from torch import Tensor

from policies.envs.images import SeenImage
from policies.packed.activations import Kept, StackedActivations
from policies.portable.convolution import Filter, output_shape

Floats = NDArray[np.float32]
AnyRows = TypeVar("AnyRows", Tensor, Floats)


@dataclass(frozen=True)
class Convolution:
    """The sizes of one convolution without padding."""

    image: tuple[int, int, int]
    """(height, width, channels) of its input."""
    num_filters: int
    kernel: int
    stride: int

    @property
    def window(self) -> int:
        """The numbers that a kernel sees, W."""
        return self.kernel * self.kernel * self.image[2]

    @cached_property
    def out(self) -> tuple[int, int, int]:
        """(height, width, channels) of its output."""
        return output_shape(self.image, [(self.num_filters, self.kernel, self.stride)])

    def windows(self, images: Tensor) -> Tensor:
        """Return the windows, (K, B * P, W), of images, (K, B, D or more); numbers after the first D are left out."""
        networks, num_images, one = images.stride()
        assert one == 1
        view = images.as_strided(
            (*images.shape[:2], *self._window_shape), (networks, num_images, *self._window_strides)
        )
        return view.reshape(len(images), -1, self.window)

    def windows_of_few(self, images: Floats) -> Floats:
        """Return the same of NumPy's arrays."""
        networks, num_images, one = images.strides
        strides = (networks, num_images, *(one * stride for stride in self._window_strides))
        view = as_strided(images, (*images.shape[:2], *self._window_shape), strides, writeable=False)
        return view.reshape(len(images), -1, self.window)

    @cached_property
    def _window_shape(self) -> tuple[int, ...]:
        height, width, _ = self.out
        return height, width, self.kernel, self.kernel * self.image[2]

    @cached_property
    def _window_strides(self) -> tuple[int, ...]:
        """The steps between places and between the rows of a window; a row of it lies in one piece."""
        _, width, channels = self.image
        return self.stride * width * channels, self.stride * channels, width * channels, 1

    def sums_of_windows(self, windows: Tensor) -> Tensor:
        """Return images, (K, B, D), each number of which is the sum of all that windows, (K, B * P, W), have of it."""
        height, width, channels = self.image
        rows, columns, _ = self.out
        parts = windows.view(-1, rows, columns, self.kernel, self.kernel, channels)
        images = windows.new_zeros(len(parts), height, width, channels)
        last_row, last_column = self.stride * (rows - 1) + 1, self.stride * (columns - 1) + 1
        for row in range(self.kernel):
            for column in range(self.kernel):
                seen = images[:, row : row + last_row : self.stride, column : column + last_column : self.stride]
                seen += parts[:, :, :, row, column]
        return images.view(len(windows), -1, height * width * channels)


def convolutions_for(image: Sequence[int], filters: Sequence[Filter] | None) -> tuple[Convolution, ...]:
    """Return the sizes of the convolutions of `conv_filters`, for images of (height, width, channels).

    Raises:
        SpecError: The observations are not images, or become smaller than a kernel.
    """
    found: list[Convolution] = []
    for number, (num_filters, kernel, stride) in enumerate(filters or ()):
        height, width, channels = output_shape(image, (filters or ())[:number])
        found.append(Convolution((height, width, channels), num_filters, kernel, stride))
    if found:
        output_shape(image, filters or ())
    return tuple(found)


class StackedConvolutions:
    """The convolutions of K networks, with an activation after each.

    Weights are given with each call, layer by layer: shape (K, W + 1, F), a kernel's numbers in a window's order, then
    the bias.

    Args:
        sizes: The convolutions, from input to output.
        activations: What each network has after each of them.
        image: The image among the numbers of an observation. What the convolutions make of it comes first among the
            features, the other numbers behind it. None: all numbers are the image's.
    """

    def __init__(
        self, sizes: Sequence[Convolution], activations: StackedActivations, image: SeenImage | None = None
    ) -> None:
        self.sizes, self._activations = tuple(sizes), activations
        is_part = image is not None and (image.num_beside > 0 or image.more or image.scale != 1.0)
        self._image = image if is_part else None
        self._kept: list[tuple[Tensor, Kept]] = []

    def forward(self, images: Tensor, layers: Sequence[Tensor]) -> Tensor:
        """Return the features, (K, B, numbers), of images, (K, B, D or more), and keep what `backward` needs."""
        self._kept = []
        num_images, beside = images.shape[1], self._beside(images)
        images = self._images(images)
        for sizes, layer in zip(self.sizes, layers, strict=True):
            windows = sizes.windows(images)
            out, kept = self._activations.apply(torch.baddbmm(layer[:, -1:], windows, layer[:, :-1]))
            self._kept.append((windows, kept))
            images = out.view(len(out), num_images, -1)
        return torch.cat([images, *beside], dim=2) if beside else images

    def evaluate(self, images: Tensor, layers: Sequence[Tensor], activations: StackedActivations) -> Tensor:
        """Return the same features of some of the networks, which have these activations, and keep nothing."""
        num_images, beside = images.shape[1], self._beside(images)
        images = self._images(images)
        for sizes, layer in zip(self.sizes, layers, strict=True):
            out, _ = activations.apply(torch.baddbmm(layer[:, -1:], sizes.windows(images), layer[:, :-1]))
            images = out.view(len(out), num_images, -1)
        return torch.cat([images, *beside], dim=2) if beside else images

    def backward(self, gradient: Tensor, layers: Sequence[Tensor], gradients: Sequence[Tensor]) -> None:
        """Write the gradients of the weights from those of the features of the last `forward`, (K, B, features)."""
        gradient = gradient[..., : math.prod(self.sizes[-1].out)]
        for number in range(len(self.sizes) - 1, -1, -1):
            sizes, (windows, kept) = self.sizes[number], self._kept[number]
            gradient = gradient.reshape(len(windows), windows.shape[1], sizes.num_filters)
            gradient = self._activations.gradient(gradient, kept)
            torch.bmm(windows.transpose(1, 2), gradient, out=gradients[number][:, :-1])
            torch.sum(gradient, dim=1, out=gradients[number][:, -1])
            if number:
                of_windows = torch.bmm(gradient, layers[number][:, :-1].transpose(1, 2))
                gradient = sizes.sums_of_windows(of_windows)
        self._kept = []

    def forward_few(self, images: Floats, layers: Sequence[tuple[Floats, Floats]]) -> Floats:
        """Return the features of a few images, in NumPy; each layer is its matrix and its bias, (K, 1, F)."""
        num_images, beside = images.shape[1], self._beside(images)
        images = self._images(images)
        for sizes, (matrix, bias) in zip(self.sizes, layers, strict=True):
            out = np.matmul(sizes.windows_of_few(images), matrix)
            out += bias
            images = self._activations.apply_to_few(out).reshape(len(out), num_images, -1)
        return np.concatenate([images, *beside], axis=2) if beside else images

    def _images(self, x: AnyRows) -> AnyRows:
        """Return the images, (K, B, D or more), among what is observed."""
        image = self._image
        if image is None:
            return x
        if not image.more:
            images = x[..., image.places[0]]
            return images if image.scale == 1.0 else images * image.scale
        members = image.members_of(x)
        joined = np.concatenate(members, axis=-1) if isinstance(x, np.ndarray) else torch.cat(members, dim=-1)
        return joined.reshape(*x.shape[:-1], -1)

    def _beside(self, x: AnyRows) -> list[AnyRows]:
        """Return what is observed beside the images, in parts; empty: nothing."""
        return [] if self._image is None else self._image.beside_of(x)

"""Compute convolutions without padding in NumPy, and the sizes of their outputs.

Words: a *filter* is `(channels, kernel, stride)`: square kernels, the same stride in both directions. Images are
(height, width, channels), as environments return them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from policies.errors import SpecError

Filter = tuple[int, int, int]


def output_shape(image_shape: Sequence[int], filters: Sequence[Filter]) -> tuple[int, int, int]:
    """Return the shape (height, width, channels) of a stack of convolutions' output for images.

    Args:
        image_shape: (height, width, channels) of the observations.
        filters: `conv_filters` of the hyperparameters.

    Raises:
        SpecError: The observations are not images, or become smaller than a kernel.
    """
    if len(image_shape) != 3:
        raise SpecError(
            f"conv_filters {[list(item) for item in filters]} need images, observations of shape (height, width, "
            f"channels), but the observations are of shape {tuple(image_shape)}.",
            "Leave conv_filters out, or set env.pixels: true.",
        )
    height, width, channels = (int(size) for size in image_shape)
    for index, (num_channels, kernel, stride) in enumerate(filters):
        if kernel > min(height, width):
            raise SpecError(
                f"conv_filters[{index}] has kernels of {kernel} x {kernel}, but its input has only {height} x {width} "
                f"pixels (observations: {tuple(image_shape)}).",
                "Use smaller kernels or strides, or fewer filters.",
            )
        height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1
        channels = num_channels
    return height, width, channels


def convolve(
    images: NDArray[np.float32], matrix: NDArray[np.float32], bias: NDArray[np.float32], *, kernel: int, stride: int
) -> NDArray[np.float32]:
    """Compute one convolution, as one matrix product per image.

    With a product for each image, an image's result does not depend on the other images, to the last bit.

    Args:
        images: Shape (num, height, width, channels).
        matrix: Shape (channels * kernel * kernel, out_channels); rows in the order channel, row, column.
        bias: Shape (out_channels,).
        kernel: Pixels along a side of the kernel.
        stride: Pixels between two positions of the kernel.

    Returns:
        Shape (num, out_height, out_width, out_channels).
    """
    # (num, out_height, out_width, channels, kernel, kernel): a view, copied by the reshape.
    windows = sliding_window_view(images, (kernel, kernel), axis=(1, 2))[:, ::stride, ::stride]
    num, height, width = windows.shape[:3]
    columns = windows.reshape(num, height * width, matrix.shape[0])
    result: NDArray[np.float32] = np.matmul(columns, matrix)
    result += bias
    return result.reshape(num, height, width, matrix.shape[1])

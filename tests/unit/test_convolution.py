from __future__ import annotations

import numpy as np
import pytest

from policies.errors import SpecError
from policies.portable.convolution import convolve, output_shape
from tests.rounding import assert_rounded


def test_a_convolution_by_its_definition() -> None:
    rng = np.random.default_rng(0)
    images = rng.normal(size=(2, 7, 6, 3)).astype(np.float32)
    kernels, bias = rng.normal(size=(4, 3, 3, 3)).astype(np.float32), rng.normal(size=4).astype(np.float32)
    result = convolve(images, kernels.reshape(4, -1).T.copy(), bias, kernel=3, stride=2)
    assert result.shape == (2, *output_shape((7, 6, 3), [(4, 3, 2)])) == (2, 3, 2, 4)
    for image, row, column, channel in np.ndindex(result.shape):
        patch = images[image, 2 * row : 2 * row + 3, 2 * column : 2 * column + 3].transpose(2, 0, 1)
        terms = np.append(patch.astype(np.float64) * kernels[channel], bias[channel])
        limits = {"sizes": np.abs(terms).sum(), "num_roundings": len(terms) + 1}
        assert_rounded(result[image, row, column, channel], terms.sum(), **limits)


def test_sizes_of_a_stack() -> None:
    # The network of Mnih et al. 2015.
    assert output_shape((84, 84, 4), [(32, 8, 4), (64, 4, 2), (64, 3, 1)]) == (7, 7, 64)
    assert output_shape((5, 9, 1), []) == (5, 9, 1)


@pytest.mark.parametrize("shape", [(4,), (), (84, 84), (1, 2, 3, 4)])
def test_convolutions_need_images(shape: tuple[int, ...]) -> None:
    with pytest.raises(SpecError, match=r"conv_filters .*\[\[8, 3, 1\]\].*need images") as caught:
        output_shape(shape, [(8, 3, 1)])
    assert str(tuple(shape)) in caught.value.message


def test_a_kernel_larger_than_its_input_is_named() -> None:
    with pytest.raises(SpecError, match=r"conv_filters\[1\] has kernels of 8 x 8.* only 7 x 9"):
        output_shape((16, 20, 3), [(8, 4, 2), (8, 8, 1)])

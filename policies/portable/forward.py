"""Compute the forward pass of a portable network in NumPy."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from policies.portable.convolution import convolve
from policies.portable.network import ConvLayer, Layer, Normalization, PolicyNetwork

_IMAGES_AT_ONCE = 32  # a convolution needs several times the memory of its images


class ForwardPass:
    """Computes a network's outputs from observations.

    To the last bit, the result for an observation does not depend on what else is in its batch.

    Args:
        network: A network with layers.
    """

    def __init__(self, network: PolicyNetwork) -> None:
        self._scale = None if network.scale == 1.0 else np.float32(network.scale)
        self._normalize = None if network.normalization is None else _Normalize(network.normalization)
        self._conv = [_Conv(layer) for layer in network.conv]
        self._image = network.image
        self.layers = [_Linear(layer) for layer in network.layers]

    @property
    def prepares(self) -> bool:
        """Whether `prepare` changes observations."""
        return self._scale is not None or self._normalize is not None

    def prepare(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return scaled and normalised observations."""
        x = observations
        if self._scale is not None:
            x = x * self._scale
        return x if self._normalize is None else self._normalize(x)

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the outputs, shape (num, num_outputs), for observations of shape (num, ...)."""
        if self._conv and len(observations) > _IMAGES_AT_ONCE:
            parts = range(0, len(observations), _IMAGES_AT_ONCE)
            return np.concatenate([self(observations[first : first + _IMAGES_AT_ONCE]) for first in parts])
        x = self.prepare(observations)
        if self._conv:
            x = self._convolved(x)
        # One vector-matrix product per observation (a stack of 1-row matrices): a single product of the batch
        # takes other BLAS kernels at other batch sizes, whose results differ in the last bit. It costs no
        # more at these sizes.
        x = x[:, None, :] if x.ndim == 2 else x.reshape(len(x), 1, math.prod(x.shape[1:]))
        for layer in self.layers:
            x = layer(x)
        return x[:, 0, :]

    def _convolved(self, x: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what the convolutions make of images, and behind it, if these are part of vectors, what is beside."""
        image = self._image
        images = x
        if image is not None:
            members = image.members_of(x)
            images = members[0] if len(members) == 1 else np.concatenate(members, axis=-1)
        for conv in self._conv:
            images = conv(images)
        images = images.transpose(0, 3, 1, 2)  # channels first, as torch flattens images
        if image is None:
            return images
        flat = images.reshape(len(images), math.prod(images.shape[1:]))  # NumPy finds no -1 for a batch of none
        return np.concatenate([flat, *image.beside_of(x)], axis=1)


class ForwardPasses:
    """Computes several networks at once, each for its own observations, with the same bits as a `ForwardPass` each.

    Args:
        passes: The forward passes of networks with layers and without convolutions, all of one `layout`.
    """

    def __init__(self, passes: Sequence[ForwardPass]) -> None:
        self._passes = passes
        self._layers = [_Linears(linears) for linears in zip(*(one.layers for one in passes), strict=True)]

    def choose(self, places: Sequence[int]) -> ForwardPasses:
        """Return the same for only some of these networks."""
        return ForwardPasses([self._passes[place] for place in places])

    @staticmethod
    def layout(network: PolicyNetwork) -> tuple[Any, ...]:
        """Return what networks must have in common to be computed at once; empty if this one cannot be."""
        if network.conv or not network.layers:
            return ()
        layers = tuple((layer.weight.shape, layer.activation) for layer in network.layers)
        return (network.scale != 1.0 or network.normalization is not None, layers)

    def __call__(self, observations: NDArray[np.float32], counts: Sequence[int]) -> NDArray[np.float32]:
        """Return the outputs, shape (num, num_outputs).

        Args:
            observations: Shape (num, n): those for the first network, then those for the second, and so on.
            counts: The number of observations for each network.
        """
        bounds = list(itertools.pairwise(itertools.accumulate(counts, initial=0)))
        x = observations
        if self._passes[0].prepares:
            parts = zip(self._passes, bounds, strict=True)
            x = np.concatenate([one.prepare(x[first:last]) for one, (first, last) in parts])
        x = x[:, None, :]
        for layer in self._layers:
            x = layer(x, bounds)
        return x[:, 0, :]


class _Normalize:
    def __init__(self, normalization: Normalization) -> None:
        self._mean, self._std = normalization.mean, normalization.std
        self._clip = np.float32(normalization.clip)

    def __call__(self, x: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(np.clip((x - self._mean) / self._std, -self._clip, self._clip), dtype=np.float32)


class _Conv:
    """A convolution, whose kernels are turned once into the matrix that the product needs."""

    def __init__(self, layer: ConvLayer) -> None:
        self._kernel, self._stride = layer.weight.shape[2], layer.stride
        self._matrix = np.ascontiguousarray(layer.weight.reshape(len(layer.weight), -1).T, dtype=np.float32)
        self._bias = np.asarray(layer.bias, dtype=np.float32)
        self._activation = _ACTIVATION_FUNCTIONS[layer.activation]

    def __call__(self, x: NDArray[np.float32]) -> NDArray[np.float32]:
        x = convolve(x, self._matrix, self._bias, kernel=self._kernel, stride=self._stride)
        return x if self._activation is None else self._activation(x)


class _Linear:
    """A layer, whose weights are transposed once into the order that the product needs."""

    def __init__(self, layer: Layer) -> None:
        self.matrix = np.ascontiguousarray(layer.weight.T, dtype=np.float32)
        self.bias = np.asarray(layer.bias, dtype=np.float32)
        self.activation = _ACTIVATION_FUNCTIONS[layer.activation]

    def __call__(self, x: NDArray[np.float32]) -> NDArray[np.float32]:
        x = np.matmul(x, self.matrix)
        x += self.bias
        return x if self.activation is None else self.activation(x)


class _Linears:
    """The same layer of several networks."""

    def __init__(self, linears: Sequence[_Linear]) -> None:
        self._linears = linears
        self._activation = linears[0].activation

    @functools.cached_property
    def _stack(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """All matrices and all biases, stacked, with an axis of length 1 for a single row."""
        matrices, biases = ([getattr(linear, name) for linear in self._linears] for name in ("matrix", "bias"))
        return np.stack(matrices)[:, None], np.stack(biases)[:, None, None]

    def __call__(self, x: NDArray[np.float32], bounds: Sequence[tuple[int, int]]) -> NDArray[np.float32]:
        if len({last - first for first, last in bounds}) == 1:
            # Each network has equally many observations: one call makes the same vector-matrix products.
            matrices, biases = self._stack
            y = np.matmul(x.reshape(len(bounds), -1, 1, x.shape[-1]), matrices)
            y += biases
            y = y.reshape(len(x), 1, -1)
        else:
            y = np.empty((len(x), 1, len(self._linears[0].bias)), dtype=np.float32)
            for linear, (first, last) in zip(self._linears, bounds, strict=True):
                part = y[first:last]
                np.matmul(x[first:last], linear.matrix, out=part)
                part += linear.bias
        return y if self._activation is None else self._activation(y)


def _relu(x: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.maximum(x, np.float32(0.0), out=x)


def _tanh(x: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.tanh(x, out=x)


def _silu(x: NDArray[np.float32]) -> NDArray[np.float32]:
    # x * sigmoid(x). For very negative x the exponential overflows, and the quotient is the right limit, -0.
    with np.errstate(over="ignore"):
        return np.asarray(x / (np.float32(1.0) + np.exp(-x)), dtype=np.float32)


def _elu(x: NDArray[np.float32]) -> NDArray[np.float32]:
    # By `np.where` it takes up to three times as long. What is added is 0 on one side or the other.
    below = np.expm1(np.minimum(x, np.float32(0.0)))
    return np.asarray(np.maximum(x, np.float32(0.0)) + below, dtype=np.float32)


def _gelu(x: NDArray[np.float32]) -> NDArray[np.float32]:
    # torch's default, the exact form: x times the normal distribution function.
    # math.erf, number by number, takes a few times as long as the layer's product; only SciPy has a faster one.
    cumulative = 0.5 * (1.0 + _erf(x / math.sqrt(2.0)).astype(np.float64))
    return np.asarray(x * cumulative, dtype=np.float32)


_erf = np.frompyfunc(math.erf, 1, 1)

_ACTIVATION_FUNCTIONS: dict[str, Callable[[NDArray[np.float32]], NDArray[np.float32]] | None] = {
    "linear": None,
    "relu": _relu,
    "tanh": _tanh,
    "silu": _silu,
    "elu": _elu,
    "gelu": _gelu,
}

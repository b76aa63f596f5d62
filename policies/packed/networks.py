"""Compute many small networks at once: their weights are stacked, so that one batched product serves them all.

Shapes: K networks, B rows per network, D numbers per row, L hidden layers, A outputs.

The networks of a stack have the same layer sizes. Smaller ones are padded with zeros, which is exact: a padded unit's
input is 0 and every activation maps 0 to 0, so its output and the gradients of all padded weights are 0, and an
optimizer that starts at 0 leaves them there. Each network may have an activation of its own.

The backward pass is written out. On networks of this size torch's graph costs more than the products in it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from policies.envs.images import SeenImage
from policies.packed.activations import Kept, StackedActivations
from policies.packed.convolutions import Convolution, StackedConvolutions
from policies.packed.sizes import LINE, NARROW

Floats = NDArray[np.float32]


def _whole_lines(num_weights: int) -> int:
    """Return how many numbers a block takes, so that the next one begins at a cache line, too."""
    return math.ceil(num_weights / LINE) * LINE


class StackedNetworks:
    """K networks of convolutions, if any, then dense layers, with the activation after each layer but the last.

    Args:
        num_networks: The number of networks, K.
        sizes: The number of inputs of the first dense layer, the units of each hidden layer, and the number of outputs.
        activations: A name of `policies.activations.ACTIVATIONS` for each network. Calls are fewest where equal ones
            are neighbours.
        device: Where the weights lie.
        convolutions: The convolutions before the dense layers, whose last output has as many numbers as `sizes` begins
            with, and all other inputs behind them.
        image: The image among the inputs that the convolutions go over; None: all inputs are the image's.

    Attributes:
        weights: All weights, shape (K, P); a layer's block is its matrix, then its bias as one more row. It begins at a
            multiple of 16 numbers; between blocks there are zeros.
        gradients: The gradients of the last `backward`, in the shape of the weights.
        layers: Views of the weights, shape (K, inputs + 1, outputs) each, those of the convolutions first.
        gradient_layers: Views of the gradients, in the same shapes.
    """

    def __init__(
        self,
        num_networks: int,
        sizes: Sequence[int],
        activations: Sequence[str],
        device: str = "cpu",
        convolutions: Sequence[Convolution] = (),
        *,
        image: SeenImage | None = None,
    ) -> None:
        self.num_networks, self.sizes = num_networks, tuple(sizes)
        self.convolutions, self.image = tuple(convolutions), image
        self._shapes = [
            *((one.window + 1, one.num_filters) for one in convolutions),
            *((inputs + 1, outputs) for inputs, outputs in itertools.pairwise(sizes)),
        ]
        num_weights = sum(_whole_lines(rows * columns) for rows, columns in self._shapes)
        self.weights = torch.zeros(num_networks, num_weights, device=device)
        self.gradients = torch.zeros_like(self.weights)
        self.layers = self._views(self.weights)
        self.gradient_layers = self._views(self.gradients)
        self.activations = StackedActivations(activations)
        self._stacked = StackedConvolutions(convolutions, self.activations, image)
        num = len(self.convolutions)
        self._dense = [_Dense(layer) for layer in self.layers[num:]]
        self._dense_gradients = [
            _Gradients(layer, with_ones=not (number or num)) for number, layer in enumerate(self.gradient_layers[num:])
        ]
        self._parts: dict[tuple[int, int], tuple[list[Tensor], list[_Dense]]] = {}
        self._kept: list[tuple[Tensor, Kept]] = []

    def _views(self, flat: Tensor) -> list[Tensor]:
        views, start = [], 0
        for rows, columns in self._shapes:
            views.append(flat[:, start : start + rows * columns].view(self.num_networks, rows, columns))
            start += _whole_lines(rows * columns)
        return views

    @property
    def multiplications_per_row(self) -> int:
        """How often one network multiplies two numbers for the outputs of one row."""
        windows = sum(math.prod(one.out) * one.window for one in self.convolutions)
        return windows + sum(inputs * outputs for inputs, outputs in itertools.pairwise(self.sizes))

    def views_of(self, flat: Tensor) -> list[Tensor]:
        """Return views of a tensor of shape (K, P), layer by layer, as in `layers`."""
        return self._views(flat)

    def forward(self, x: Tensor) -> Tensor:
        """Return the outputs, shape (K, B, A), for inputs with a last column of ones, shape (K, B, D + 1).

        Convolutions leave out whatever is after the first D columns.
        """
        self._kept = []
        num = len(self.convolutions)
        if num:
            x = self._stacked.forward(x, self.layers[:num])
        for number, layer in enumerate(self._dense[:-1]):
            # The column of ones makes the first bias a part of the product.
            x = self._activate(x, layer.product(x) if number or num else torch.bmm(x, layer.whole))
        self._kept.append((x, x))
        return self._dense[-1].product(x)

    def _activate(self, inputs: Tensor, x: Tensor) -> Tensor:
        out, kept = self.activations.apply(x)
        self._kept.append((inputs, kept))
        return out

    def evaluate(self, x: Tensor, start: int, stop: int) -> Tensor:
        """Return the outputs of only the networks from start to stop; nothing is kept for a `backward`."""
        convolutions, dense = self._part(start, stop)
        activations = self.activations.part(start, stop)
        if convolutions:
            x = self._stacked.evaluate(x, convolutions, activations)
            x = dense[0].product(x)
        else:
            x = torch.bmm(x, dense[0].whole)
        for layer in dense[1:]:
            x, _ = activations.apply(x)
            x = layer.product(x)
        return x

    def _part(self, start: int, stop: int) -> tuple[list[Tensor], list[_Dense]]:
        """Return the convolutions and the dense layers of only the networks from start to stop."""
        if (start, stop) not in self._parts:
            num = len(self.convolutions)
            layers = [layer[start:stop] for layer in self.layers]
            self._parts[start, stop] = layers[:num], [_Dense(layer) for layer in layers[num:]]
        return self._parts[start, stop]

    def backward(self, gradient: Tensor) -> None:
        """Set `gradients` from the gradient of the outputs of the last `forward`, shape (K, B, A)."""
        num = len(self.convolutions)
        x, _ = self._kept[-1]
        self._dense_gradients[-1].set(x, gradient)
        for number in range(len(self._dense) - 2, -1, -1):
            gradient = self._dense[number + 1].gradient_of_inputs(gradient)
            x, kept = self._kept[number]
            gradient = self.activations.gradient(gradient, kept)
            self._dense_gradients[number].set(x, gradient)
        if num:
            gradient = self._dense[0].gradient_of_inputs(gradient)
            self._stacked.backward(gradient, self.layers[:num], self.gradient_layers[:num])
        self._kept = []


class _Dense:
    """A dense layer of some networks, whose weights are views, (K, inputs + 1, outputs), the biases last.

    What is the same at each call is found once: each view of a tensor takes microseconds, and an update needs dozens.
    """

    def __init__(self, layer: Tensor) -> None:
        self.whole, self._matrix, self._biases = layer, layer[:, :-1], layer[:, -1:]
        self._transposed = self._matrix.transpose(1, 2)
        self._is_narrow = _is_narrow(layer)
        if self._is_narrow:
            self._matrix_array, self._biases_array = self._matrix.numpy(), self._biases.numpy()

    def product(self, x: Tensor) -> Tensor:
        """Return the outputs, (K, B, outputs), for inputs of shape (K, B, inputs)."""
        if self._is_narrow:
            out = np.matmul(x.numpy(), self._matrix_array)
            out += self._biases_array
            return torch.from_numpy(out)
        return torch.baddbmm(self._biases, x, self._matrix)

    def gradient_of_inputs(self, gradient: Tensor) -> Tensor:
        """Return the gradient of the inputs, (K, B, inputs), from that of the outputs."""
        return torch.bmm(gradient, self._transposed)


class _Gradients:
    """The gradients of a dense layer, in the same form as its weights.

    Args:
        layer: What they are written into.
        with_ones: Whether the inputs have a last column of ones, so that those of the biases come of the product, too.
    """

    def __init__(self, layer: Tensor, *, with_ones: bool) -> None:
        self._of_product = layer if with_ones else layer[:, :-1]
        self._of_biases = None if with_ones else layer[:, -1]
        self._array = self._of_product.numpy() if _is_narrow(self._of_product) else None

    def set(self, x: Tensor, gradient: Tensor) -> None:
        """Write them, from the inputs, (K, B, inputs), and the gradient of the outputs, (K, B, outputs)."""
        if self._array is not None:
            np.matmul(x.numpy().swapaxes(1, 2), gradient.numpy(), out=self._array)
        else:
            torch.bmm(x.transpose(1, 2), gradient, out=self._of_product)
        if self._of_biases is not None:
            torch.sum(gradient, dim=1, out=self._of_biases)


def _is_narrow(layer: Tensor) -> bool:
    """Whether NumPy multiplies by a layer, because it has few inputs or outputs.

    For two outputs it takes a seventh of the time of torch's MKL on an AMD EPYC (2 x 64 numbers a network, 128 rows, 5
    networks), and each network's product is one of its own, so that it rounds alike wherever that is in the stack.
    """
    return min(layer.shape[1:]) < NARROW and layer.device.type == "cpu"


def with_ones(x: Floats) -> Floats:
    """Return rows with a last column of ones, as `StackedNetworks.forward` takes them."""
    out = np.empty((*x.shape[:-1], x.shape[-1] + 1), dtype=np.float32)
    out[..., :-1] = x
    out[..., -1] = 1.0
    return out

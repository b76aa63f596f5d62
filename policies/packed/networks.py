"""Compute many small networks at once: their weights are stacked, so that one batched product serves them all.

Shapes: K networks, B rows per network, D numbers per row, L hidden layers, A outputs.

The networks of a stack have the same activation and layer sizes. Smaller ones are padded with zeros, which is exact: a
padded unit's input is 0 and every activation maps 0 to 0, so its output and the gradients of all padded weights are 0,
and an optimizer that starts at 0 leaves them there.

The backward pass is written out. On networks of this size torch's graph costs more than the products in it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

_aten = torch.ops.aten

Floats = NDArray[np.float32]


# torch's own elu and silu compute the last few numbers of an array by another routine than the others, so that a number
# would depend on how many other networks there are. exp and expm1 do not.


def _elu(x: Tensor) -> Tensor:
    return torch.where(x > 0.0, x, torch.expm1(x))


def _elu_backward(gradient: Tensor, kept: Tensor) -> Tensor:
    return torch.where(kept > 0.0, gradient, gradient * torch.exp(kept))


def _silu(x: Tensor) -> Tensor:
    return x / (torch.exp(-x) + 1.0)


def _silu_backward(gradient: Tensor, kept: Tensor) -> Tensor:
    sigmoid = 1.0 / (torch.exp(-kept) + 1.0)
    return gradient * sigmoid * (1.0 + kept * (1.0 - sigmoid))


def _relu_backward(gradient: Tensor, kept: Tensor) -> Tensor:
    return _aten.threshold_backward(gradient, kept, 0)  # type: ignore[no-any-return]


def _relu_of_few(x: Floats) -> Floats:
    return np.maximum(x, np.float32(0.0), out=x)


def _tanh_of_few(x: Floats) -> Floats:
    return np.tanh(x, out=x)


@dataclass(frozen=True)
class _Activation:
    """The functions of one activation; `linear` has none."""

    forward: Callable[[Tensor], Tensor] | None = None
    backward: Callable[[Tensor, Tensor], Tensor] | None = None
    """Computes the gradient of the input from the gradient of the output and what the forward pass kept."""
    keeps_input: bool = False
    """Whether the derivative needs the input; otherwise it needs the output, which is computed in place."""
    of_few: Callable[[Floats], Floats] | None = None
    """The forward pass of a few rows in NumPy; None: torch is used."""


_ACTIVATIONS = {
    "linear": _Activation(),
    "relu": _Activation(torch.relu_, _relu_backward, of_few=_relu_of_few),
    "tanh": _Activation(torch.tanh_, _aten.tanh_backward, of_few=_tanh_of_few),
    "silu": _Activation(_silu, _silu_backward, keeps_input=True),
    "elu": _Activation(_elu, _elu_backward, keeps_input=True),
    "gelu": _Activation(functional.gelu, _aten.gelu_backward, keeps_input=True),
}


class StackedNetworks:
    """K networks of dense layers, with the activation after each layer but the last.

    Args:
        num_networks: The number of networks, K.
        sizes: The number of inputs, the units of each hidden layer, and the number of outputs.
        activation: A name of `policies.activations.ACTIVATIONS`.
        device: Where the weights lie.

    Attributes:
        weights: All weights, shape (K, P); a layer's block is its matrix, then its bias as one more row.
        gradients: The gradients of the last `backward`, in the shape of the weights.
        layers: Views of the weights, shape (K, inputs + 1, outputs) each.
    """

    def __init__(self, num_networks: int, sizes: Sequence[int], activation: str, device: str = "cpu") -> None:
        self.num_networks, self.sizes, self.activation = num_networks, tuple(sizes), activation
        num_weights = sum((inputs + 1) * outputs for inputs, outputs in itertools.pairwise(sizes))
        self.weights = torch.zeros(num_networks, num_weights, device=device)
        self.gradients = torch.zeros_like(self.weights)
        self.layers = self._views(self.weights)
        self._gradient_layers = self._views(self.gradients)
        self._function = _ACTIVATIONS[activation].forward
        self._input_gradient = _ACTIVATIONS[activation].backward
        self._keeps_input = _ACTIVATIONS[activation].keeps_input
        self._kept: list[tuple[Tensor, Tensor]] = []

    def _views(self, flat: Tensor) -> list[Tensor]:
        views, start = [], 0
        for inputs, outputs in itertools.pairwise(self.sizes):
            stop = start + (inputs + 1) * outputs
            views.append(flat[:, start:stop].view(self.num_networks, inputs + 1, outputs))
            start = stop
        return views

    def views_of(self, flat: Tensor) -> list[Tensor]:
        """Return views of a tensor of shape (K, P), layer by layer, as in `layers`."""
        return self._views(flat)

    def forward(self, x: Tensor) -> Tensor:
        """Return the outputs, shape (K, B, A), for inputs with a last column of ones, shape (K, B, D + 1)."""
        self._kept = []
        # The column of ones makes the first bias a part of the product.
        x = self._activate(x, torch.bmm(x, self.layers[0]))
        for layer in self.layers[1:-1]:
            x = self._activate(x, torch.baddbmm(layer[:, -1:], x, layer[:, :-1]))
        self._kept.append((x, x))
        last = self.layers[-1]
        return torch.baddbmm(last[:, -1:], x, last[:, :-1])

    def _activate(self, inputs: Tensor, x: Tensor) -> Tensor:
        out = x if self._function is None else self._function(x)
        self._kept.append((inputs, x if self._keeps_input else out))
        return out

    def evaluate(self, x: Tensor, start: int, stop: int) -> Tensor:
        """Return the outputs of only the networks from start to stop; nothing is kept for a `backward`."""
        x = torch.bmm(x, self.layers[0][start:stop])
        for layer in self.layers[1:]:
            x = x if self._function is None else self._function(x)
            x = torch.baddbmm(layer[start:stop, -1:], x, layer[start:stop, :-1])
        return x

    def backward(self, gradient: Tensor) -> None:
        """Set `gradients` from the gradient of the outputs of the last `forward`, shape (K, B, A)."""
        x, _ = self._kept[-1]
        self._set_gradients(-1, x, gradient)
        for number in range(len(self.layers) - 2, -1, -1):
            gradient = torch.bmm(gradient, self.layers[number + 1][:, :-1].transpose(1, 2))
            x, kept = self._kept[number]
            if self._input_gradient is not None:
                gradient = self._input_gradient(gradient, kept)
            if number == 0:
                torch.bmm(x.transpose(1, 2), gradient, out=self._gradient_layers[0])
            else:
                self._set_gradients(number, x, gradient)
        self._kept = []

    def _set_gradients(self, number: int, x: Tensor, gradient: Tensor) -> None:
        views = self._gradient_layers[number]
        torch.bmm(x.transpose(1, 2), gradient, out=views[:, :-1])
        torch.sum(gradient, dim=1, out=views[:, -1])


def with_ones(x: Floats) -> Floats:
    """Return rows with a last column of ones, as `StackedNetworks.forward` takes them."""
    out = np.empty((*x.shape[:-1], x.shape[-1] + 1), dtype=np.float32)
    out[..., :-1] = x
    out[..., -1] = 1.0
    return out


class ActingNetworks:
    """The forward pass in NumPy, for the few rows of one env step: a call takes a third of torch's time.

    Args:
        networks: The networks whose weights are copied at each `refresh`.
        num_acting: How many of the networks act, counted from the first.
    """

    def __init__(self, networks: StackedNetworks, num_acting: int) -> None:
        self._networks, self._num_acting = networks, num_acting
        self._activation = _ACTIVATIONS[networks.activation]
        self.refresh()

    def refresh(self) -> None:
        """Copy the present weights."""
        self._layers = []
        for layer in self._networks.layers:
            values = layer[: self._num_acting].detach().cpu().numpy()
            self._layers.append((values[:, :-1], values[:, -1:]))

    def __call__(self, x: Floats) -> Floats:
        """Return the outputs, shape (num_acting, B, A), for inputs of shape (num_acting, B, D)."""
        for matrix, bias in self._layers[:-1]:
            x = np.matmul(x, matrix)
            x += bias
            x = self._activate(x)
        matrix, bias = self._layers[-1]
        out: Floats = np.matmul(x, matrix)
        out += bias
        return out

    def _activate(self, x: Floats) -> Floats:
        if self._activation.of_few is not None:
            return self._activation.of_few(x)
        function = self._activation.forward
        return x if function is None else function(torch.from_numpy(x)).numpy()

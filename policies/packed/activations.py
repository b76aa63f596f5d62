"""The activations of stacked networks, with their derivatives written out."""

from __future__ import annotations

from collections.abc import Callable
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


def _tanh(x: Tensor) -> Tensor:
    # NumPy's takes a tenth of the time of torch's on a CPU, which is more than that of the product before it: both are
    # exact to a unit in the last place or two.
    if x.device.type != "cpu":
        return x.tanh_()
    values = x.numpy()
    np.tanh(values, out=values)
    return x


@dataclass(frozen=True)
class Activation:
    """The functions of one activation; `linear` has none."""

    forward: Callable[[Tensor], Tensor] | None = None
    backward: Callable[[Tensor, Tensor], Tensor] | None = None
    """Computes the gradient of the input from the gradient of the output and what the forward pass kept."""
    keeps_input: bool = False
    """Whether the derivative needs the input; otherwise it needs the output, which is computed in place."""
    of_few: Callable[[Floats], Floats] | None = None
    """The forward pass of a few rows in NumPy; None: torch is used."""

    def apply(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the output, computed in place if it can be, and what `backward` needs of it."""
        out = x if self.forward is None else self.forward(x)
        return out, x if self.keeps_input else out

    def gradient(self, gradient: Tensor, kept: Tensor) -> Tensor:
        """Return the gradient of the input from that of the output."""
        return gradient if self.backward is None else self.backward(gradient, kept)

    def apply_to_few(self, x: Floats) -> Floats:
        """Return the output for a few rows, which may be computed in place."""
        if self.of_few is not None:
            return self.of_few(x)
        return x if self.forward is None else self.forward(torch.from_numpy(x)).numpy()


ACTIVATIONS = {
    "linear": Activation(),
    "relu": Activation(torch.relu_, _relu_backward, of_few=_relu_of_few),
    "tanh": Activation(_tanh, _aten.tanh_backward, of_few=_tanh_of_few),
    "silu": Activation(_silu, _silu_backward, keeps_input=True),
    "elu": Activation(_elu, _elu_backward, keeps_input=True),
    "gelu": Activation(functional.gelu, _aten.gelu_backward, keeps_input=True),
}

"""The activations of stacked networks, with their derivatives written out."""

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
Kept = Tensor | list[Tensor]
"""What a backward pass needs: of all networks in one, or of each run of networks with one activation."""


# torch's own elu and silu compute the last few numbers of an array by another routine than the others, so that a number
# would depend on how many other networks there are. exp and expm1 do not.
# ELU's two cases are told apart by limits, which give the same to the last bit. By `where` they take CPUs up to five
# times as long, as these can't guess which comes next.


def _elu(x: Tensor) -> Tensor:
    return torch.expm1(x.clamp(max=0.0)).add_(x.clamp(min=0.0))


def _elu_backward(gradient: Tensor, kept: Tensor) -> Tensor:
    return kept.clamp(max=0.0).exp_().mul_(gradient)


def _silu(x: Tensor) -> Tensor:
    # x / (1 + e^-x); in place, as a cache holds few arrays of this size.
    out = torch.neg(x).exp_().add_(1.0)
    return torch.div(x, out, out=out)


def _silu_backward(gradient: Tensor, kept: Tensor) -> Tensor:
    # gradient * s * (1 + x * (1 - s)), with s = 1 / (1 + e^-x)
    sigmoid = torch.neg(kept).exp_().add_(1.0).reciprocal_()
    slope = (1.0 - sigmoid).mul_(kept).add_(1.0)
    return sigmoid.mul_(gradient).mul_(slope)


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


class StackedActivations:
    """The activations of stacked networks, of which each may have another: those in a run of one kind are one call.

    Args:
        names: A name of `policies.activations.ACTIVATIONS` for each network, K of them.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names, runs, start = tuple(names), [], 0
        for name, alike in itertools.groupby(names):
            stop = start + len(list(alike))
            runs.append((slice(start, stop), ACTIVATIONS[name]))
            start = stop
        self._runs: Sequence[tuple[slice, Activation]] = runs
        self._one = runs[0][1] if len(runs) == 1 else None
        self._keeps_input = any(activation.keeps_input for _, activation in runs)
        self._parts: dict[tuple[int, int], StackedActivations] = {}

    def part(self, start: int, stop: int) -> StackedActivations:
        """Return those of the networks from start to stop."""
        if (start, stop) not in self._parts:  # each update of DQN asks for them
            self._parts[start, stop] = StackedActivations(self._names[start:stop])
        return self._parts[start, stop]

    def apply(self, x: Tensor) -> tuple[Tensor, Kept]:
        """Return the outputs, (K, ...), computed in place if they can be, and what `gradient` needs of them."""
        if self._one is not None:
            return self._one.apply(x)
        out, kept = x.clone() if self._keeps_input else x, []
        for run, activation in self._runs:
            part = out[run]
            if activation.forward is not None and (found := activation.forward(part)) is not part:
                part.copy_(found)
            kept.append(x[run] if activation.keeps_input else part)
        return out, kept

    def gradient(self, gradient: Tensor, kept: Kept) -> Tensor:
        """Return the gradient of the inputs from that of the outputs, (K, ...), whose memory it may take."""
        if isinstance(kept, Tensor):
            assert self._one is not None
            return self._one.gradient(gradient, kept)
        for (run, activation), of_run in zip(self._runs, kept, strict=True):
            if activation.backward is not None:
                part = gradient[run]
                part.copy_(activation.backward(part, of_run))
        return gradient

    def apply_to_few(self, x: Floats) -> Floats:
        """Return the outputs for a few rows, (K, ...), which may be computed in place."""
        if self._one is not None:
            return self._one.apply_to_few(x)
        for run, activation in self._runs:
            part = x[run]
            if (found := activation.apply_to_few(part)) is not part:
                part[...] = found
        return x

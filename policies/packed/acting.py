"""Act with stacked networks: the forward pass of the few rows of one env step, where that takes the least time.

Shapes: M networks that act, N rows (sub-environments) per network, D numbers per observation, A outputs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from policies.packed.convolutions import StackedConvolutions
from policies.packed.networks import StackedNetworks, with_ones

Floats = NDArray[np.float32]

_MULTIPLICATIONS, _WEIGHTS = 5_000_000, 750_000
"""From about so many multiplications in an env step, or weights that have to be fetched for it, a core takes longer
than a GPU: 0.03 ns for one, and 0.2 ns for the other where a cache can't hold them, beside 0.15 ms of the GPU's calls.
So it was with a core of an Intel Xeon and an NVIDIA H100."""


PrepareBytes = Callable[[Tensor], Tensor]
"""Makes of images of bytes, (M, N, D), what networks see of them."""


class Acting(Protocol):
    """Computes what networks make of observations."""

    def refresh(self) -> None:
        """Act with the present weights from now on."""
        ...

    def __call__(self, x: NDArray[Any], prepare_bytes: PrepareBytes | None = None) -> Floats:
        """Return the outputs, (M, N, A).

        Args:
            x: Prepared observations, (M, N, D), or bytes of images as they were observed.
            prepare_bytes: Prepares the bytes; None: there are none.
        """
        ...


def make_acting(networks: StackedNetworks, num_acting: int, num_rows: int) -> Acting:
    """Return what acts with the first of some networks, on their GPU if they have one and are large enough for it.

    Args:
        networks: The networks, whose present weights are taken.
        num_acting: How many of them act, counted from the first.
        num_rows: The rows of each in an env step.
    """
    if networks.weights.device.type != "cpu" and _are_large(networks, num_acting, num_rows):
        return ActingOnDevice(networks, num_acting)
    return ActingNetworks(networks, num_acting)


def _are_large(networks: StackedNetworks, num_acting: int, num_rows: int) -> bool:
    num_weights = num_acting * networks.weights.shape[1]
    num_multiplications = num_acting * num_rows * networks.multiplications_per_row
    return num_multiplications >= _MULTIPLICATIONS or num_weights >= _WEIGHTS


class ActingNetworks:
    """The forward pass in NumPy, for the few rows of one env step: a call takes a third of torch's time.

    Args:
        networks: The networks whose weights are copied at each `refresh`.
        num_acting: How many of the networks act, counted from the first.
    """

    def __init__(self, networks: StackedNetworks, num_acting: int) -> None:
        self._networks, self._num_acting = networks, num_acting
        self._activations = networks.activations.part(0, num_acting)
        self._num_convolutions = len(networks.convolutions)
        self._convolutions = StackedConvolutions(networks.convolutions, self._activations, networks.image)
        self.refresh()

    def refresh(self) -> None:
        """Copy the present weights."""
        self._layers = []
        for layer in self._networks.layers:
            values = layer[: self._num_acting].detach().cpu().numpy()
            self._layers.append((values[:, :-1], values[:, -1:]))

    def __call__(self, x: NDArray[Any], prepare_bytes: PrepareBytes | None = None) -> Floats:
        """Return the outputs; see `Acting`."""
        if prepare_bytes is not None:
            x = prepare_bytes(torch.from_numpy(x)).numpy()
        num = self._num_convolutions
        if num:
            x = self._convolutions.forward_few(x, self._layers[:num])
        for matrix, bias in self._layers[num:-1]:
            x = np.matmul(x, matrix)
            x += bias
            x = self._activations.apply_to_few(x)
        matrix, bias = self._layers[-1]
        out: Floats = np.matmul(x, matrix)
        out += bias
        return out


class ActingOnDevice:
    """The forward pass on the device where the weights lie, for networks over which a core would take longer.

    Args:
        networks: The networks, whose weights are not copied: nobody may act while they are being updated.
        num_acting: How many of the networks act, counted from the first.
    """

    def __init__(self, networks: StackedNetworks, num_acting: int) -> None:
        self._networks, self._num_acting = networks, num_acting

    def refresh(self) -> None:
        """Do nothing: the weights are used where they lie."""

    @torch.inference_mode()
    def __call__(self, x: NDArray[Any], prepare_bytes: PrepareBytes | None = None) -> Floats:
        """Return the outputs; see `Acting`. Bytes are prepared on the device, as they are a quarter of the numbers."""
        if prepare_bytes is not None:
            rows = prepare_bytes(torch.from_numpy(x).to(self._networks.weights.device))
        else:
            rows = torch.from_numpy(x if self._networks.convolutions else with_ones(x)).to(self._networks.weights)
        found: Floats = self._networks.evaluate(rows, 0, self._num_acting).cpu().numpy()
        return found

"""Every activation is known wherever networks are computed, and is the same function there."""

from typing import Any, cast

import numpy as np
import pytest
import torch
from torch.nn import functional

from policies.activations import ACTIVATIONS
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM, Algorithm
from policies.networks import layers, parts
from policies.packed import activations as packed_activations
from policies.portable import forward
from tests.narrowing import present

TABLES: dict[str, Any] = {
    "torch's modules": layers._ACTIVATIONS,
    "RLlib's names": parts.RLLIB_ACTIVATIONS,
    "portable policies": forward._ACTIVATION_FUNCTIONS,
    "packs": packed_activations.ACTIVATIONS,
}
VALUES = [-20.0, -3.0, -0.5, -1e-6, 0.0, 1e-6, 0.7, 4.0, 30.0]


@pytest.mark.parametrize("where", TABLES)
def test_every_floor_knows_every_activation_and_no_other(where: str) -> None:
    assert tuple(TABLES[where]) == ACTIVATIONS


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_a_sweep_file_may_name_each(algorithm: Algorithm) -> None:
    for name in ACTIVATIONS:
        made = cast("Any", HYPERPARAMS_BY_ALGORITHM[algorithm])(activation=name)
        assert made.activation == name


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_all_compute_the_same_function(name: str) -> None:
    x = np.array([VALUES], dtype=np.float32)
    expected = x if name == "linear" else getattr(functional, name)(torch.from_numpy(x)).numpy()
    module = layers._ACTIVATIONS[name]
    assert module is None or np.array_equal(module()(torch.from_numpy(x)).numpy(), expected)
    portable = forward._ACTIVATION_FUNCTIONS[name]
    assert portable is None or np.allclose(portable(x.copy()), expected, rtol=1e-6, atol=1e-6)
    packed = packed_activations.ACTIVATIONS[name]
    if packed.forward is not None:
        assert_as_close(name, packed.forward(torch.from_numpy(x.copy())), torch.from_numpy(expected))
    assert packed.of_few is None or np.allclose(packed.of_few(x.copy()), expected, rtol=1e-6, atol=1e-6)
    assert expected[0, VALUES.index(0.0)] == 0.0  # padding stays zero


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_the_gradients_of_packs_are_those_of_torch(name: str) -> None:
    x = torch.tensor([VALUES], requires_grad=True)
    packed = packed_activations.ACTIVATIONS[name]
    out = x if name == "linear" else getattr(functional, name)(x)
    out.sum().backward()
    kept = (x if packed.keeps_input else out).detach()
    found = torch.ones_like(kept) if packed.backward is None else packed.backward(torch.ones_like(kept), kept)
    assert_as_close(name, found, present(x.grad))


def assert_as_close(name: str, found: torch.Tensor, expected: torch.Tensor) -> None:
    """Check that numbers are torch's own; of silu, elu and tanh but for their last bits.

    Packs write out two and take NumPy's tanh: a few roundings of float32, each of at most 6e-8 of a number, of a
    formula of five operations.
    """
    if name in ("silu", "elu", "tanh"):
        torch.testing.assert_close(found, expected, rtol=5e-7, atol=5e-8)
    else:
        assert torch.equal(found, expected)

"""How far a computation may lie from its exact result by rounding alone, on any machine.

A tolerance that one CPU's rounding meets is none: another one adds in another order, in wider registers or with fused
multiply-adds. What holds on all of them is the bound of a sum's error (Higham 2002, "Accuracy and Stability of
Numerical Algorithms", sections 3.1 and 4.2): n roundings move the sum of terms t by n * u * sum(|t|) at most, to first
order and in whatever order they are added; u is the unit roundoff, half of the format's eps. Where terms cancel, the
result gets smaller and its error does not: sizes are sums of absolute values, never those of the result.

The exact result is the same formula in float64, whose own error is a billionth of float32's. What can be computed in
float64 itself is compared there: `close` leaves a hundred thousand roundings to sums that cancel to a hundredth, and
finds any error of a formula.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def bound(sizes: Any, num_roundings: int, dtype: type[np.floating[Any]] = np.float32) -> Any:
    """The largest error of results whose terms' absolute values sum up to `sizes`.

    Args:
        sizes: Sums of the absolute values of all that is added; of a product, its absolute value.
        num_roundings: Operations between an input and the result, each of which rounds once.
        dtype: What was computed in.
    """
    info = np.finfo(dtype)
    # Where results underflow, the error is no share of their size any more.
    return num_roundings * (info.eps / 2 * np.abs(np.asarray(sizes, dtype=np.float64)) + info.tiny)


def close(found: Any, expected: Any) -> None:
    """That two results in float64 are the same."""
    found, expected = (np.asarray(values) for values in (found, expected))
    assert found.dtype == expected.dtype == np.float64
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def assert_rounded(found: Any, exact: Any, *, sizes: Any, num_roundings: int, what: str = "") -> None:
    """That each of `found`, computed in float32, is the exact one but for rounding; see `bound`."""
    found, exact = (np.asarray(values, dtype=np.float64) for values in (found, exact))
    assert found.shape == exact.shape, (what, found.shape, exact.shape)
    limit = np.broadcast_to(bound(sizes, num_roundings), found.shape)
    wrong = ~(np.abs(found - exact) <= limit)
    assert not wrong.any(), (
        f"{what} {wrong.sum()} of {wrong.size} differ by more than {num_roundings} roundings: "
        f"{found[wrong][:3]} instead of {exact[wrong][:3]}, by {np.abs(found - exact)[wrong][:3]}, "
        f"and at most {limit[wrong][:3]} is rounding."
    )


def dense(layers: Any, x: Any) -> tuple[Any, int]:
    """(sizes, roundings) of the outputs of dense layers, for `assert_rounded`.

    The sizes are the outputs of the same network with absolute weights and inputs and without activations, since
    |f(x)| <= |x| for each of these. A layer adds as many products as it has inputs, and a bias; an activation is a few
    operations. Slopes of up to 1.13 (SiLU, GELU) make larger what was rounded in the layers before.

    Args:
        layers: With `weight`, (outputs, inputs), and `bias`; the first one first.
        x: (num, inputs).
    """
    sizes, num_roundings = np.abs(np.asarray(x, dtype=np.float64)), 0.0
    for layer in layers:
        weight, bias = (np.abs(np.asarray(values, dtype=np.float64)) for values in (layer.weight, layer.bias))
        sizes = sizes @ weight.T + bias
        num_roundings = 1.13 * num_roundings + weight.shape[1] + 9
    return sizes, math.ceil(num_roundings)


def assert_network(found: Any, expected: Any, *, num_terms: int) -> None:
    """That outputs of two programs for the same network in float32 are the same but for rounding.

    Both are off. Where terms are of either sign and at random, as a network's are, n of them sum up to about the root
    of n of their sizes, and as many roundings add up to about their root as well: n * u of the largest output, for each
    program, bounds what is far beyond the root. An error of a formula moves outputs by more than a thousandth.

    Args:
        found: Outputs.
        expected: Outputs.
        num_terms: Products in all layers on the way to an output, and 10 for each activation.
    """
    largest = float(np.abs(np.asarray(expected, dtype=np.float64)).max())
    assert 2 * bound(1.0, num_terms) < 1e-3
    assert_rounded(found, expected, sizes=largest, num_roundings=2 * num_terms)


def assert_greedy(actions: Any, expected: Any, outputs: Any, *, num_terms: int) -> None:
    """That actions are those of another program for the same network, but where two outputs are equal but for rounding.

    Args:
        actions: Found, from 0.
        expected: The other program's.
        outputs: Of either, (num, actions).
        num_terms: As `assert_network`.
    """
    actions, expected, outputs = (np.asarray(values) for values in (actions, expected, outputs))
    rows = np.flatnonzero(actions != expected)
    assert len(rows) < len(actions) / 100
    limit = 4 * bound(np.abs(outputs).max(), num_terms)
    assert (np.abs(outputs[rows, actions[rows]] - outputs[rows, expected[rows]]) <= limit).all()

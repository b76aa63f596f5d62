"""Which sizes let a member's place in its group round its sums, though nothing is padded."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from networks_alone import check_alone

from policies.activations import ACTIVATIONS
from policies.hyperparams import DQNHyperparams, PPOHyperparams
from policies.packed.acting import ActingNetworks
from policies.packed.networks import StackedNetworks
from policies.packed.sizes import may_round_by_place


@pytest.mark.parametrize(
    ("values", "num_outputs", "expected"),
    [
        ({}, 2, False),
        ({"minibatch_size": 63}, 2, True),
        ({"minibatch_size": 64, "num_envs": 3, "hidden_sizes": (64, 64)}, 2, False),
        ({"minibatch_size": 64, "num_envs": 3, "hidden_sizes": (17, 17)}, 2, True),
        ({"num_envs": 16, "hidden_sizes": (17, 33)}, 2, False),
        ({"num_envs": 4, "conv_filters": ((4, 3, 1),)}, 2, False),
        ({"num_envs": 2, "conv_filters": ((4, 3, 1),)}, 2, True),
        # From 16 outputs on torch multiplies by the last layer, too.
        ({"num_envs": 4}, 15, False),
        ({"num_envs": 4}, 15 + 3, True),
        ({"num_envs": 4}, 20, False),
        ({"num_envs": 4, "vf_share_layers": True}, 19, False),
        ({"num_envs": 4, "vf_share_layers": True}, 20, True),
        ({"num_envs": 16}, None, False),
        ({"num_envs": 8}, None, True),
        ({"num_envs": 16, "hidden_sizes": (1, 64)}, 2, True),
    ],
)
def test_rows_and_units_of_ppo_that_are_no_whole_cache_lines(
    values: dict[str, Any], num_outputs: int | None, expected: bool
) -> None:
    assert may_round_by_place(PPOHyperparams(**values), num_outputs) is expected


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({}, False),
        ({"train_batch_size": 33}, True),
        # Its networks act in NumPy, and see batches alone.
        ({"train_batch_size": 48, "num_envs": 3, "hidden_sizes": (17,)}, False),
        ({"hidden_sizes": (1,)}, True),
    ],
)
def test_of_dqn_the_batch_counts(values: dict[str, Any], expected: bool) -> None:
    assert may_round_by_place(DQNHyperparams(**values), 4) is expected


@pytest.mark.parametrize("num_outputs", [4, 18])
@pytest.mark.parametrize("hidden_sizes", [(17, 33), (8, 33), (20, 64)])
@pytest.mark.parametrize("num_rows", [16, 48])
def test_in_whole_cache_lines_the_place_rounds_nothing(
    num_rows: int, hidden_sizes: tuple[int, ...], num_outputs: int
) -> None:
    rng = torch.Generator().manual_seed(num_rows)
    stack, alone = (StackedNetworks(number, (9, *hidden_sizes, num_outputs), ["tanh"] * number) for number in (4, 1))
    stack.weights.normal_(generator=rng)
    x, gradient = (torch.randn(4, num_rows, number, generator=rng) for number in (10, num_outputs))
    check_alone(stack, alone, x, gradient)


@pytest.mark.parametrize("hidden_sizes", [(32,), (17, 33)])
@pytest.mark.parametrize("beside", ACTIVATIONS)
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_nor_do_the_activations_beside_it(activation: str, beside: str, hidden_sizes: tuple[int, ...]) -> None:
    """Of three networks the first and the last have another one than that between them."""
    rng = torch.Generator().manual_seed(len(hidden_sizes))
    sizes, num_rows = (9, *hidden_sizes, 2), 48
    stack = StackedNetworks(3, sizes, [beside, activation, beside])
    stack.weights.normal_(generator=rng)
    x, gradient = (torch.randn(3, num_rows, number, generator=rng) for number in (10, 2))
    alone = StackedNetworks(1, sizes, [activation])
    outputs = stack.forward(x)
    stack.backward(gradient)
    found = stack.gradients.clone()
    alone.weights.copy_(stack.weights[1:2])
    assert torch.equal(alone.forward(x[1:2]), outputs[1:2])
    assert torch.equal(stack.evaluate(x[1:2], 1, 2), outputs[1:2])
    alone.backward(gradient[1:2])
    assert torch.equal(alone.gradients, found[1:2])
    few = x[..., :-1].numpy()
    assert np.array_equal(ActingNetworks(stack, 3)(few)[1], ActingNetworks(alone, 1)(few[1:2])[0])

"""Stacked networks compute what separate torch modules compute, padding included."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from networks_alone import check_alone
from numpy.typing import NDArray
from packed_members import NUM_INPUTS, NUM_OUTPUTS, Reference, random_member

from policies.activations import ACTIVATIONS
from policies.hyperparams import PPOHyperparams
from policies.packed.acting import ActingNetworks, ActingOnDevice
from policies.packed.member import MAX_GROUP, group_members, network_layouts
from policies.packed.networks import StackedNetworks, with_ones
from policies.packed.optimizers import StackedAdam, StackedRMSprop
from policies.packed.rows import StackedRows
from policies.packed.sizes import is_padded_beside, size_class
from tests.narrowing import present
from tests.rounding import close

if TYPE_CHECKING:
    from policies.packed.member import Member

# Of the members of one stack, by the number of layers: the second is padded in every layer, the third in one.
SIZES: dict[int, list[tuple[int, ...]]] = {
    1: [(12,), (7,), (9,)],
    2: [(12, 9), (5, 4), (11, 9)],
    3: [(8, 12, 6), (7, 5, 4), (8, 12, 3)],
}
ROWS = 10
# Each network with one of its own: computed in place, beside one that keeps its input, and of two of one kind.
MIXED = ("relu-linear-tanh", "silu-elu-gelu", "linear-silu-relu", "gelu-tanh-tanh")


def make_stack(num_layers: int, activation: str, *, shares: bool) -> tuple[list[Member[PPOHyperparams]], StackedRows]:
    """Make members with one activation or, of `MIXED`, with one each."""
    names = itertools.cycle(activation.split("-"))
    members = [
        random_member(f"m{index}", index, hidden_sizes=sizes, activation=name, vf_share_layers=shares)
        for index, (sizes, name) in enumerate(zip(SIZES[num_layers], names, strict=False))
    ]
    return members, StackedRows(members, (NUM_INPUTS,), NUM_OUTPUTS, "cpu")


def observations(num_members: int, seed: int = 0) -> torch.Tensor:
    # Numbers of float32, as observations are, in whatever format the networks compute.
    rng = torch.Generator().manual_seed(seed)
    return torch.randn(num_members, ROWS, NUM_INPUTS, generator=rng, dtype=torch.float32).to(torch.get_default_dtype())


def stacked_inputs(rows: StackedRows, x: torch.Tensor) -> torch.Tensor:
    inputs = torch.from_numpy(with_ones(x.numpy())).to(x.dtype)
    return inputs.repeat(rows.networks_per_member, 1, 1)


def outputs_of(rows: StackedRows, x: torch.Tensor) -> torch.Tensor:
    """(M, B, policy outputs and value), like the references'."""
    out = rows.networks.forward(stacked_inputs(rows, x))
    if rows.networks_per_member == 1:
        return out
    return torch.cat((out[: len(x)], out[len(x) :, :, :1]), dim=-1)


def backward(rows: StackedRows, gradient: torch.Tensor) -> None:
    """As `outputs_of`, the other way round."""
    networks, num_members = rows.networks, len(gradient)
    if rows.networks_per_member == 1:
        networks.backward(gradient)
        return
    full = torch.zeros(networks.num_networks, ROWS, networks.sizes[-1])
    full[:num_members] = gradient[..., :-1]
    full[num_members:, :, 0] = gradient[..., -1]
    networks.backward(full)


def by_name(
    rows: StackedRows, flat: torch.Tensor, members: Sequence[Member[PPOHyperparams]], index: int
) -> dict[str, NDArray[np.float64]]:
    """A member's part of a tensor over all weights, (K, P)."""
    found: dict[str, Any] = {}
    for number, layout in enumerate(network_layouts(members[index].hyperparams, NUM_OUTPUTS)):
        row = number * len(members) + index
        found |= layout.read([layer[row] for layer in rows.networks.views_of(flat)], NUM_INPUTS)
    return found


def is_padding(rows: StackedRows, members: Sequence[Member[PPOHyperparams]]) -> torch.Tensor:
    """Which of all weights, (K, P), no member has."""
    flat = torch.zeros_like(rows.networks.weights)
    views = rows.networks.views_of(flat)
    for index, member in enumerate(members):
        ones = {name: np.ones_like(value) for name, value in member.weights.items()}
        for number, layout in enumerate(network_layouts(member.hyperparams, NUM_OUTPUTS)):
            layout.write([layer[number * len(members) + index] for layer in views], ones)
    return flat == 0


@pytest.mark.parametrize("shares", [False, True])
@pytest.mark.parametrize("num_layers", sorted(SIZES))
@pytest.mark.parametrize("activation", [*ACTIVATIONS, *MIXED])
@pytest.mark.usefixtures("in_double")
def test_outputs_and_gradients_are_those_of_separate_modules(activation: str, num_layers: int, shares: bool) -> None:
    members, rows = make_stack(num_layers, activation, shares=shares)
    x = observations(len(members))
    upstream = torch.randn(len(members), ROWS, NUM_OUTPUTS + 1, generator=torch.Generator().manual_seed(1))
    found = outputs_of(rows, x)
    acting = [make(rows.networks, len(members))(x.numpy()) for make in (ActingNetworks, ActingOnDevice)]
    evaluated = rows.networks.evaluate(stacked_inputs(rows, x)[: len(members)], 0, len(members))
    backward(rows, upstream)
    for index, member in enumerate(members):
        reference = Reference(member)
        expected = reference(x[index])
        close(found[index], expected.detach())
        for other in (*(torch.from_numpy(each[index]) for each in acting), evaluated[index]):
            close(other[:, :NUM_OUTPUTS], expected[:, :NUM_OUTPUTS].detach())
        expected.backward(upstream[index])
        gradients = by_name(rows, rows.networks.gradients, members, index)
        assert set(gradients) == set(member.weights)
        for name, weight in reference.named():
            assert present(weight.grad).abs().max() > 1e-3
            close(torch.from_numpy(gradients[name]), weight.grad)


def test_weights_that_are_written_into_a_stack_come_back() -> None:
    members, rows = make_stack(2, "tanh", shares=True)
    before = [dict(member.weights) for member in members]
    rows.networks.weights.mul_(2.0)
    rows.write_back()
    for member, weights in zip(members, before, strict=True):
        assert set(member.weights) == set(weights)
        for name, value in weights.items():
            np.testing.assert_array_equal(member.weights[name], 2 * value)


@pytest.mark.parametrize("kind", ["adam", "rmsprop"])
@pytest.mark.parametrize("activation", [*ACTIVATIONS, *MIXED])
def test_padding_stays_zero(activation: str, kind: str) -> None:
    members, rows = make_stack(3, activation, shares=False)
    networks, column = rows.networks, torch.full((2 * len(members), 1), 0.9)
    optimizer: StackedAdam | StackedRMSprop
    if kind == "adam":
        optimizer = StackedAdam(networks.weights, column * 0.01, column.double(), column.double(), column * 1e-8)
    else:
        optimizer = StackedRMSprop(networks.weights, column * 0.01, column.double(), column, column * 1e-8)
    padding = is_padding(rows, members)
    assert 0.1 < padding.float().mean() < 0.9
    first = networks.weights.clone()
    for seed in range(5):
        out = outputs_of(rows, observations(len(members), seed))
        backward(rows, torch.sin(3 * out))
        optimizer.step(networks.gradients)
        for values in (networks.gradients, networks.weights, *optimizer.state.values()):
            assert (values[padding] == 0).all()
            assert values.isfinite().all()
    # Some units of ReLUs are dead.
    assert (networks.weights != first)[~padding].float().mean() > 0.8


# -- groups


def test_sizes_are_padded_by_a_third_at_most() -> None:
    sizes = sorted({size_class(number) for number in range(1, 2000)})
    assert sizes[:7] == [8, 12, 16, 24, 32, 48, 64]
    for number in range(1, 2000):
        padded = size_class(number)
        assert padded >= number
        # The next smaller class would not have been enough.
        assert padded == 8 or sizes[sizes.index(padded) - 1] < number
        assert size_class(padded) == padded


def test_groups_are_of_like_sizes_with_equal_activations_side_by_side() -> None:
    rng = np.random.default_rng(0)
    members = [
        random_member(f"m{index}", hidden_sizes=(int(rng.choice([9, 12, 30])), 8), activation=str(activation))
        for index, activation in enumerate(rng.choice(["relu", "tanh", "linear"], size=60))
    ]
    groups = group_members(members)
    assert sorted(member.member_id for group in groups for member in group) == sorted(m.member_id for m in members)
    for group in groups:
        activations = [member.hyperparams.activation for member in group]
        assert len([name for name, _ in itertools.groupby(activations)]) == len(set(activations))
        assert len({size_class(member.hyperparams.hidden_sizes[0]) for member in group}) == 1
    assert any(len({member.hyperparams.activation for member in group}) > 1 for group in groups)
    sizes = [len(group) for group in groups]
    assert max(sizes) <= MAX_GROUP
    # As few as there can be, and of even sizes.
    classes = [size_class(member.hyperparams.hidden_sizes[0]) for member in members]
    assert len(groups) == sum(math.ceil(classes.count(one) / MAX_GROUP) for one in set(classes))
    assert min(sizes) >= MAX_GROUP // 2


@pytest.mark.parametrize(
    ("ours", "theirs", "expected"),
    [
        ({"hidden_sizes": (21, 18)}, {"hidden_sizes": (24, 18)}, True),
        ({"hidden_sizes": (24, 18)}, {"hidden_sizes": (21, 18)}, False),
        ({"hidden_sizes": (21, 24)}, {"hidden_sizes": (24, 21)}, True),
        ({"hidden_sizes": (32,)}, {"hidden_sizes": (64,)}, False),
        ({"hidden_sizes": (21,)}, {"hidden_sizes": (24,), "activation": "relu"}, True),
        ({"hidden_sizes": (21,)}, {"hidden_sizes": (21, 24)}, False),
        ({"hidden_sizes": (21,)}, {"hidden_sizes": (21,), "lr": 1e-2}, False),
    ],
)
def test_a_member_is_padded_beside_a_wider_one_of_its_group(
    ours: dict[str, Any], theirs: dict[str, Any], expected: bool
) -> None:
    one, two = random_member("a", **ours), random_member("b", **theirs)
    assert is_padded_beside(one.hyperparams, two.hyperparams) is expected
    (group,) = (found for found in group_members([one, two]) if one in found)
    sizes = StackedRows(group, (4,), 3, "cpu").networks.sizes[1:-1]
    assert (sizes != one.hyperparams.hidden_sizes) is expected


def test_networks_of_other_depth_are_not_grouped() -> None:
    one, two = random_member("a", hidden_sizes=(8,)), random_member("b", hidden_sizes=(8, 8))
    assert len(group_members([one, two])) == 2


def test_a_stack_starts_without_weights() -> None:
    networks = StackedNetworks(2, (3, 4, 1), ["relu"] * 2)
    assert networks.weights.shape == (2, 16 + 16)
    assert (networks.weights == 0).all()


def test_every_layer_of_every_network_begins_at_a_cache_line() -> None:
    """Otherwise kernels of some CPUs round by a network's place in the stack."""
    networks = StackedNetworks(3, (3, 5, 7, 2), ["relu"] * 3)
    for layers in (networks.layers, networks.gradient_layers):
        assert [tuple(layer.shape[1:]) for layer in layers] == [(4, 5), (6, 7), (8, 2)]
        assert {layer[row].data_ptr() % 64 for layer in layers for row in range(3)} == {0}


@pytest.mark.parametrize("num_outputs", [1, 2, 3, 5, 6, 15])
def test_what_a_network_computes_does_not_depend_on_its_place_in_the_stack(num_outputs: int) -> None:
    rng = torch.Generator().manual_seed(num_outputs)
    stack, alone = (StackedNetworks(number, (9, 32, 32, num_outputs), ["relu"] * number) for number in (5, 1))
    stack.weights.normal_(generator=rng)
    for num_rows in (32, 33, 128):
        x, gradient = (torch.randn(5, num_rows, number, generator=rng) for number in (10, num_outputs))
        outputs = check_alone(stack, alone, x, gradient)
        assert torch.equal(stack.evaluate(x[1:4], 1, 4), outputs[1:4])

"""Stacked convolutions compute what torch's do, forwards and backwards, network by network."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch
from packed_members import MODULES
from torch import nn

from policies.activations import ACTIVATIONS
from policies.envs.masks import MaskedBox
from policies.envs.spaces import observation_dtype
from policies.errors import SpecError
from policies.hyperparams import DQNHyperparams, PPOHyperparams
from policies.networks.denormals import denormals_as_zero
from policies.networks.layers import observation_scale
from policies.packed import optimizers
from policies.packed.acting import ActingNetworks, ActingOnDevice
from policies.packed.convolutions import convolutions_for
from policies.packed.initial import new_member
from policies.packed.inputs import Inputs
from policies.packed.member import Member, group_members, network_layouts
from policies.packed.networks import with_ones
from policies.packed.optimizers import StackedAdam, StackedRMSprop
from policies.packed.rows import StackedRows
from policies.packed.sampling import Observations

IMAGE = (9, 7, 3)
# Places between the windows that no kernel sees, windows that overlap, and a kernel of one pixel.
FILTERS: list[tuple[tuple[int, int, int], ...]] = [
    ((4, 2, 3),),
    ((5, 3, 1), (2, 2, 2)),
    ((3, 1, 1), (4, 3, 2), (2, 1, 1)),
]
B = 6
# The longest sum: 7 rows of 5 places, times the images; each of its numbers is of as many operations as layers.
ROUNDING = (B * 35 + 40) * 6e-8


def space_of(dtype: Any = np.float32) -> Any:
    import gymnasium as gym

    return gym.spaces.Box(0, 255 if dtype == np.uint8 else 1, IMAGE, dtype)


def make_members(filters: Sequence[Any], activation: str = "tanh") -> list[Member[PPOHyperparams]]:
    """Make members with one activation, or with each one of those that are named with "-" between."""
    import gymnasium as gym

    names = itertools.cycle(activation.split("-"))
    settings = [
        PPOHyperparams(
            hidden_sizes=sizes,
            conv_filters=tuple(filters),
            initializer="orthogonal",
            activation=cast("Any", name),
        )
        for sizes, name in zip(((7,), (5,), (8,)), names, strict=False)
    ]
    return [
        new_member(f"m{index}", one, index, space_of(), gym.spaces.Discrete(3)) for index, one in enumerate(settings)
    ]


def torch_networks(member: Member[PPOHyperparams]) -> list[nn.Sequential]:
    """Policy and value function of a member, in torch's modules and float64."""
    found = []
    for layout in network_layouts(member.hyperparams, 3, convolutions_for(IMAGE, member.hyperparams.conv_filters)):
        layers: list[nn.Module] = []
        for number, parts in enumerate(layout.layers):
            (part,) = parts
            weight, bias = (torch.from_numpy(member.weights[f"{part.name}.{kind}"]) for kind in ("weight", "bias"))
            layer: nn.Conv2d | nn.Linear
            if ".conv." in part.name:
                stride = (member.hyperparams.conv_filters or ())[number][2]
                layer = nn.Conv2d(weight.shape[1], weight.shape[0], weight.shape[2], stride)
            else:
                layers += [nn.Flatten()] if number and ".conv." in layout.layers[number - 1][0].name else []
                layer = nn.Linear(weight.shape[1], weight.shape[0])
            layer.weight, layer.bias = nn.Parameter(weight.double()), nn.Parameter(bias.double())
            layers += [layer, MODULES[member.hyperparams.activation]()]
        found.append(nn.Sequential(*layers[:-1]))
    return found


@pytest.mark.parametrize("activation", [*ACTIVATIONS, "relu-linear-tanh", "silu-relu-gelu"])
@pytest.mark.parametrize("filters", FILTERS, ids=str)
def test_outputs_and_gradients_are_torchs(filters: tuple[Any, ...], activation: str) -> None:
    members = make_members(filters, activation=activation)
    rows = StackedRows(members, IMAGE, 3, "cpu")
    images = torch.rand(len(members), B, *IMAGE, generator=torch.Generator().manual_seed(1))
    inputs = torch.from_numpy(with_ones(images.reshape(len(members), B, -1).numpy())).repeat(2, 1, 1)
    outputs = rows.networks.forward(inputs)
    evaluated = rows.networks.evaluate(inputs[: len(members)], len(members), 2 * len(members))
    # Not to the bit: weights that begin elsewhere in memory are multiplied by another kernel on some CPUs.
    np.testing.assert_allclose(evaluated, outputs[len(members) :], atol=ROUNDING)
    for make in (ActingNetworks, ActingOnDevice):
        acted = make(rows.networks, len(members))(images.reshape(len(members), B, -1).numpy())
        np.testing.assert_allclose(acted, outputs[: len(members)], atol=ROUNDING)
    gradient = torch.zeros_like(outputs)
    for index, member in enumerate(members):
        for row, size, network in zip((index, len(members) + index), (3, 1), torch_networks(member), strict=True):
            expected = network(images[index].permute(0, 3, 1, 2).double())
            np.testing.assert_allclose(outputs[row, :, :size], expected.detach(), atol=ROUNDING)
            slope = torch.cos(5 * expected.detach())
            gradient[row, :, :size] = slope
            expected.backward(slope)
            found = [(layer.weight.grad, layer.bias.grad) for layer in network if hasattr(layer, "weight")]
            member.moments.setdefault("expected", {}).update(
                {
                    f"{part.name}.{kind}": np.asarray(value)
                    for (part,), pair in zip(rows._layouts[index][row >= len(members)].layers, found, strict=True)
                    for kind, value in zip(("weight", "bias"), pair, strict=True)
                }
            )
    rows.networks.backward(gradient)
    for row, layers, owner, layout in rows._rows(rows.networks.views_of(rows.networks.gradients)):
        for name, value in layout.read(layers, 0).items():
            expected = owner.moments["expected"][name]
            assert value.shape == expected.shape
            np.testing.assert_allclose(value, expected, atol=ROUNDING * max(1.0, np.abs(expected).max()), err_msg=name)
            assert np.abs(expected).max() > 0 or owner.hyperparams.activation == "relu", (row, name)


@pytest.mark.parametrize("filters", FILTERS, ids=str)
def test_what_is_written_is_read(filters: tuple[Any, ...]) -> None:
    members = make_members(filters)
    rows = StackedRows(members, IMAGE, 3, "cpu")
    before = [{name: value.copy() for name, value in member.weights.items()} for member in members]
    for member in members:
        for value in member.weights.values():
            value[...] = 0
    rows.write_back()
    for member, weights in zip(members, before, strict=True):
        assert set(member.weights) == set(weights)
        for name, value in weights.items():
            np.testing.assert_array_equal(member.weights[name], value, err_msg=name)


def test_members_of_other_filters_are_in_other_groups() -> None:
    members = [*make_members(FILTERS[0]), *make_members(FILTERS[1]), *make_members(FILTERS[0])]
    groups = group_members(members)
    assert sorted(len(group) for group in groups) == [3, 6]
    assert all(len({member.hyperparams.conv_filters for member in group}) == 1 for group in groups)


def test_filters_that_do_not_fit_are_refused() -> None:
    with pytest.raises(SpecError, match=r"conv_filters\[1\] has kernels of 5 x 5, but its input has only 3 x 2"):
        convolutions_for(IMAGE, ((4, 2, 3), (4, 5, 1)))
    with pytest.raises(SpecError, match="need images"):
        convolutions_for((4,), ((4, 2, 3),))
    assert convolutions_for((4,), None) == ()


@pytest.mark.parametrize("shape", [(2, 3, 1), (2, 2, 1), (4, 4, 4)], ids=str)
def test_bytes_lie_in_columns_and_come_out_as_they_were(shape: tuple[int, ...]) -> None:
    """Also those that are no numbers, or next to zero, as floating-point ones: what copies them computes nothing."""
    inputs = Inputs(shape, np.uint8, 1 / 255)
    images = np.random.default_rng(0).integers(0, 256, (50, 3, inputs.num_inputs), dtype=np.uint8)
    images[0], images[1], images[2, :, 1:] = 255, 0, 0
    columns = np.zeros((50, 3, inputs.num_columns + 2), np.float32)
    inputs.put(columns[..., : inputs.num_columns], images)
    assert inputs.num_columns == -(-inputs.num_inputs // 4)
    assert not columns[..., inputs.num_columns :].any()
    with denormals_as_zero():
        moved = columns.reshape(150, -1).take(np.arange(150), axis=0).reshape(columns.shape)
        rows = torch.from_numpy(moved).view(150, -1).index_select(0, torch.arange(150))[:, : inputs.num_columns]
    np.testing.assert_array_equal(inputs.bytes_in(moved[..., : inputs.num_columns]), images)
    np.testing.assert_array_equal(inputs.bytes_in_tensor(rows), images.reshape(150, -1))


@pytest.mark.parametrize(("highest", "scale"), [(255, 1 / 255), (1, 1.0), (9, 1 / 9), (0, 1.0)])
def test_bytes_are_scaled_by_the_largest_that_there_may_be(highest: int, scale: float) -> None:
    space = gym.spaces.Box(0, highest, (4, 4, 16), np.uint8)
    masked = MaskedBox(space, (4,))
    stacked = gym.spaces.Box(0, highest, (4, 4, 32), np.uint8)
    assert Inputs.of(space).scale == Inputs.of(masked).scale == Inputs.of(stacked).scale == scale
    assert observation_scale(gym.spaces.Box(0, highest, (4, 4, 16), np.float32)) == 1.0
    boards = np.random.default_rng(0).integers(0, highest + 1, (3, 4, 4, 16), dtype=np.uint8)
    seen = Observations([cast("Any", None)], 3, normalizes=False, seen=Inputs.of(space)).prepare(boards.reshape(3, -1))
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen[0], boards.reshape(3, -1) * scale, rtol=1e-6)


@pytest.mark.parametrize(("dtype", "scale"), [(np.uint8, 1 / 255), (np.float32, 1.0)])
def test_images_keep_their_dtype(dtype: Any, scale: float) -> None:
    inputs = Inputs.of(space_of(dtype))
    assert (inputs.shape, inputs.dtype, inputs.scale, inputs.is_image) == (IMAGE, dtype, scale, True)
    assert inputs.dtype == observation_dtype(space_of(dtype))
    assert inputs.num_columns == (48 if dtype == np.uint8 else 190)


@pytest.mark.parametrize("kind", ["adam", "rmsprop"])
def test_weights_that_are_moved_in_pieces_become_the_same(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    first, gradients = torch.randn(3, 1001, generator=generator), torch.randn(4, 3, 1001, generator=generator)

    def moved(at_once: int) -> list[torch.Tensor]:
        monkeypatch.setattr(optimizers, "_NUMBERS_AT_ONCE", at_once)
        weights, column = first.clone(), torch.full((3, 1), 0.9)
        optimizer: StackedAdam | StackedRMSprop
        if kind == "adam":
            optimizer = StackedAdam(weights, column * 0.01, column.double(), column.double(), column * 1e-8)
        else:
            optimizer = StackedRMSprop(weights, column * 0.01, column.double(), column, column * 1e-8)
        for gradient in gradients:
            optimizer.step(gradient)
        assert len(list(optimizers._in_pieces(weights))) == (1 if at_once > 1000 else -(-1001 // (at_once // 3)))
        return [weights, *optimizer.state.values()]

    whole = moved(10_000)
    for at_once in (50, 301):
        for one, other in itertools.zip_longest(moved(at_once), whole):
            assert torch.equal(one, other)


def test_dqns_heads_follow_the_images_features() -> None:
    layout = network_layouts(
        DQNHyperparams(conv_filters=FILTERS[1], hidden_sizes=(6,)), 3, convolutions_for(IMAGE, FILTERS[1])
    )[0]
    names = [[part.name for part in parts] for parts in layout.layers]
    assert names == [["encoder.conv.0"], ["encoder.conv.2"], ["encoder.mlp.0"], ["af", "vf"]]
    assert layout.layers[2][0].planes == (2, 3, 2)

"""Stacked networks and optimizers compute what separate torch modules and torch.optim compute, padding included."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
import torch
from networks_alone import check_alone
from numpy.typing import NDArray
from packed_members import NUM_INPUTS, NUM_OUTPUTS, Reference, random_member

from policies.activations import ACTIVATIONS
from policies.hyperparams import PPOHyperparams
from policies.packed import optimizers
from policies.packed.member import MAX_GROUP, group_members, network_layouts
from policies.packed.networks import ActingNetworks, StackedNetworks, with_ones
from policies.packed.optimizers import FUSED_FROM, StackedAdam, StackedRMSprop, can_fuse, clip_by_global_norm
from policies.packed.rows import StackedRows
from policies.packed.sizes import is_padded_beside, size_class
from tests.narrowing import present
from tests.rounding import assert_rounded, close

if TYPE_CHECKING:
    from torch.optim.adam import Adam
    from torch.optim.rmsprop import RMSprop

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
    acting = ActingNetworks(rows.networks, len(members))(x.numpy())
    evaluated = rows.networks.evaluate(stacked_inputs(rows, x)[: len(members)], 0, len(members))
    backward(rows, upstream)
    for index, member in enumerate(members):
        reference = Reference(member)
        expected = reference(x[index])
        close(found[index], expected.detach())
        for other in (torch.from_numpy(acting[index]), evaluated[index]):
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


# -- optimizers

NUM_WEIGHTS = 17
# Of eight steps, each about ten operations with its settings' own roundings; decays below 1 make older ones smaller.
NUM_ROUNDINGS = 80


class Separate:
    """A row's weights in float64 with an optimizer of torch's own, which has made some steps before.

    With `sizes`, all terms are of one sign: the weights and each moment are then the sums of the absolute values of
    what they are made of.
    """

    def __init__(
        self, make: type[Adam | RMSprop], first: torch.Tensor, settings: dict[str, Any], *, sizes: bool = False
    ) -> None:
        self._sizes = sizes
        self.weight = torch.nn.Parameter(first.double().abs() if sizes else first.double())
        self.optimizer = make([self.weight], **settings)

    def step(self, gradient: torch.Tensor) -> None:
        self.weight.grad = -gradient.double().abs() if self._sizes else gradient.double()
        self.optimizer.step()

    def set_lr(self, lr: float) -> None:
        self.optimizer.param_groups[0]["lr"] = lr

    @property
    def state(self) -> dict[str, torch.Tensor]:
        return cast("dict[str, torch.Tensor]", self.optimizer.state.get(self.weight, {}))


def take_over(optimizer: StackedAdam | StackedRMSprop, rows: Sequence[Separate]) -> None:
    for index, row in enumerate(rows):
        for name in optimizer.state.keys() & row.state.keys():
            optimizer.state[name][index] = row.state[name]
        optimizer.num_steps[index] = 3 * index


def compare_with_torch(
    stacked: Callable[[torch.Tensor], StackedAdam | StackedRMSprop],
    make_separate: type[Adam | RMSprop],
    columns: Mapping[str, Sequence[float | tuple[float, float]]],
    num_weights: int = NUM_WEIGHTS,
) -> None:
    """Two stretches of four steps beside torch.optim; row k has made 3 * k steps before."""
    rng = torch.Generator().manual_seed(0)
    settings = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
    first = torch.randn(len(settings), num_weights, generator=rng)
    rows = [Separate(make_separate, *pair) for pair in zip(first, settings, strict=True)]
    sizes = [Separate(make_separate, *pair, sizes=True) for pair in zip(first, settings, strict=True)]
    for index in range(len(rows)):
        for gradient in torch.randn(3 * index, num_weights, generator=rng):
            rows[index].step(gradient)
            sizes[index].step(gradient)
    weights = torch.stack([row.weight.detach().float() for row in rows])
    optimizer = stacked(weights)
    take_over(optimizer, rows)
    for change in (1.0, 0.3):
        optimizer.lr = torch.tensor(columns["lr"])[:, None] * change
        for row, found in zip([*rows, *sizes], settings * 2, strict=True):
            row.set_lr(found["lr"] * change)
        optimizer.begin(4)
        for _ in range(4):
            # Of sizes that differ as much as networks' gradients do.
            gradients = torch.randn(len(rows), num_weights, generator=rng) * torch.logspace(-5, 2, num_weights)
            optimizer.step(gradients)
            for index, (row, size) in enumerate(zip(rows, sizes, strict=True)):
                row.step(gradients[index])
                size.step(gradients[index])
                assert_rounded(
                    weights[index], row.weight.detach(), sizes=size.weight.detach(), num_roundings=NUM_ROUNDINGS
                )
    for index, (row, size) in enumerate(zip(rows, sizes, strict=True)):
        for name in optimizer.state.keys() & row.state.keys():
            if row.state[name] is not None:
                limits: dict[str, Any] = {"sizes": size.state[name].abs(), "num_roundings": NUM_ROUNDINGS, "what": name}
                assert_rounded(optimizer.state[name][index], row.state[name], **limits)
        assert optimizer.num_steps[index].item() == 3 * index + 8


def as_columns(values: Sequence[float], dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.tensor(values, dtype=dtype)[:, None]


@pytest.mark.parametrize("num_weights", [NUM_WEIGHTS, FUSED_FROM + 3])
def test_adam_is_torchs_row_by_row(num_weights: int) -> None:
    # The last row has the settings of the first: fused, one call moves both.
    values: dict[str, Any] = {
        "lr": [1e-3, 0.02, 0.3, 1e-3],
        "betas": [(0.9, 0.999), (0.0, 0.99), (0.95, 0.9), (0.9, 0.999)],
        "eps": [1e-8, 1e-3, 0.5, 1e-8],
    }
    beta1, beta2 = (as_columns([pair[at] for pair in values["betas"]], torch.float64) for at in (0, 1))
    compare_with_torch(
        lambda weights: StackedAdam(weights, as_columns(values["lr"]), beta1, beta2, as_columns(values["eps"])),
        torch.optim.Adam,
        values,
        num_weights,
    )


def test_wide_networks_take_the_fused_step_and_are_moved_alike_alone_and_beside_others() -> None:
    assert can_fuse("cpu")
    assert not can_fuse("cuda")
    rng = torch.Generator().manual_seed(0)
    columns = [as_columns(values) for values in ([1e-3, 1e-3, 0.1], [1e-8, 1e-8, 1e-3])]
    betas = [as_columns(values, torch.float64) for values in ([0.9, 0.9, 0.5], [0.999, 0.999, 0.9])]
    for num_weights in (FUSED_FROM - 1, FUSED_FROM, FUSED_FROM + 5):
        first = torch.randn(3, num_weights, generator=rng)
        gradients = torch.randn(6, 3, num_weights, generator=rng)

        def moved(rows: slice, first: torch.Tensor = first, gradients: torch.Tensor = gradients) -> torch.Tensor:
            weights = torch.stack(list(first[rows]))
            adam = StackedAdam(weights, columns[0][rows], betas[0][rows], betas[1][rows], columns[1][rows])
            assert (adam._fused is not None) == (first.shape[1] >= FUSED_FROM)
            adam.num_steps += 4
            adam.begin(4)
            for number, gradient in enumerate(gradients):
                if number == 4:
                    adam.lr = adam.lr * 0.5
                    adam.begin(2)
                adam.step(gradient[rows])
            return weights

        together = moved(slice(0, 3))
        for row in range(3):
            assert torch.equal(moved(slice(row, row + 1))[0], together[row])


def test_without_the_fused_step_adam_is_the_same_but_for_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = torch.Generator().manual_seed(1)
    first, gradient = torch.randn(2, 2, FUSED_FROM, generator=rng).unbind()

    def moved() -> torch.Tensor:
        weights, column = first.clone(), torch.full((2, 1), 0.5)
        adam = StackedAdam(weights, column * 0.02, column.double(), column.double(), column * 1e-8)
        for _ in range(3):
            adam.step(gradient)
        return weights

    fused = moved()
    monkeypatch.setattr(optimizers, "can_fuse", lambda _: False)
    # Three steps of 0.01 at most, ten operations each.
    assert_rounded(moved(), fused, sizes=first.abs() + 0.03, num_roundings=2 * 30)


@pytest.mark.parametrize("momentum", [[0.0, 0.0, 0.0], [0.9, 0.0, 0.5]])
def test_rmsprop_is_torchs_row_by_row(momentum: list[float]) -> None:
    values = {"lr": [1e-3, 0.02, 0.3], "alpha": [0.999, 0.9, 0.5], "momentum": momentum, "eps": [1e-8, 1e-3, 0.5]}
    columns = {name: as_columns(column) for name, column in values.items()}
    columns["alpha"] = as_columns(values["alpha"], torch.float64)
    compare_with_torch(
        lambda weights: StackedRMSprop(weights, columns["lr"], columns["alpha"], columns["momentum"], columns["eps"]),
        torch.optim.RMSprop,
        values,
    )


@pytest.mark.usefixtures("in_double")
def test_the_norm_of_all_of_a_members_networks_is_clipped() -> None:
    before = torch.randn(6, NUM_WEIGHTS, generator=torch.Generator().manual_seed(0))
    before[[0, 3]] *= 0.01
    limits = torch.tensor([[1.0], [0.5], [math.inf]])
    after = before.clone()
    norms = clip_by_global_norm(after, limits, 2)
    for member in range(3):
        own = [member, 3 + member]
        norm = before[own].square().sum().sqrt()
        close(norms[member, 0], norm)
        # Below the limit, above it, and without one.
        factor = [1.0, 0.5 / float(norm + 1e-6), 1.0][member]
        close(after[own], before[own] * factor)
    assert float(norms[1]) > 2.0


def test_a_member_is_clipped_alike_alone_and_beside_others() -> None:
    for together in torch.randn(300, 4, NUM_WEIGHTS, generator=torch.Generator().manual_seed(0)):
        alone = together[[0, 2]].clone()
        for gradients in (together, alone):
            clip_by_global_norm(gradients, torch.full((len(gradients) // 2, 1), 0.5), 2)
        assert torch.equal(alone, together[[0, 2]])


@pytest.mark.usefixtures("in_double")
def test_what_is_no_number_stays_so_under_clipping_and_stays_where_it_is() -> None:
    gradients = torch.ones(2, NUM_WEIGHTS)
    gradients[0, 3] = math.nan
    clip_by_global_norm(gradients, torch.tensor([[1.0], [1.0]]), 1)
    assert gradients[0].isnan().all()
    norm = math.sqrt(NUM_WEIGHTS)
    close(gradients[1].norm(), norm / (norm + 1e-6))


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

"""Stacked optimizers move each row as torch.optim moves its weights, alone or beside others; gradients are clipped."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import pytest
import torch

from policies.packed import optimizers
from policies.packed.optimizers import (
    _STEPS_AHEAD,
    FUSED_FROM,
    StackedAdam,
    StackedRMSprop,
    can_fuse,
    clip_by_global_norm,
)
from tests.rounding import assert_rounded, close

if TYPE_CHECKING:
    from torch.optim.adam import Adam
    from torch.optim.rmsprop import RMSprop

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


@pytest.mark.parametrize("num_weights", [NUM_WEIGHTS, FUSED_FROM])
def test_steps_beyond_those_that_were_announced_take_the_present_learning_rate(num_weights: int) -> None:
    weights, column = torch.zeros(1, num_weights), torch.full((1, 1), 0.5)
    adam = StackedAdam(weights, column, column.double(), column.double(), column * 1e-8)
    adam.begin(1)
    adam.step(torch.ones(1, num_weights))
    adam.lr = torch.zeros(1, 1)
    before = weights.clone()
    adam.step(torch.ones(1, num_weights))
    assert torch.equal(weights, before)
    assert (before < -0.4).all()


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


def test_corrections_that_were_computed_ahead_are_those_of_the_steps() -> None:
    """Past the last that is known, in phases of any length, and where the numbers of steps were set meanwhile."""
    rng = torch.Generator().manual_seed(0)
    beta1, beta2 = (as_columns(values, torch.float64) for values in ([0.9, 0.5, 0.0], [0.999, 0.9, 0.99]))

    def moved(gradients: torch.Tensor, *, ahead: bool) -> torch.Tensor:
        adam = StackedAdam(
            torch.zeros(3, 2), as_columns([1e-3, 0.1, 0.2]), beta1, beta2, as_columns([1e-8, 1e-3, 1e-8])
        )
        adam.num_steps[1] += 5
        lengths = itertools.cycle((1, 4, 7, 40, 2))
        number = 0
        while number < len(gradients):
            length = min(next(lengths), len(gradients) - number)
            if number == 12:
                adam.num_steps[2] = 1
            if not ahead:
                adam._known = None
            adam.begin(length)
            for gradient in gradients[number : number + length]:
                adam.step(gradient)
            number += length
        return adam.weights

    gradients = torch.randn(3 * _STEPS_AHEAD, 3, 2, generator=rng)
    torch.testing.assert_close(moved(gradients, ahead=True), moved(gradients, ahead=False), rtol=0, atol=0)

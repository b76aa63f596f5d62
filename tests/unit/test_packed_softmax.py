"""Probabilities of few values are computed down the columns: as PyTorch's are, and for each member by itself."""

import math
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from policies.envs.masks import FORBIDDEN
from policies.packed.ppo.softmax import log_softmax, sum_of_values
from tests.rounding import assert_rounded

SHAPES = [(5, 16, 2), (10, 256, 3), (3, 64, 7), (4, 48, 8), (3, 100, 2), (1, 256, 1), (2, 4096, 6)]


def logits_of(*shape: int, scale: float = 5.0) -> Tensor:
    return scale * torch.randn(*shape, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("scale", [0.01, 5.0, 100.0])
def test_they_are_those_of_float64(shape: tuple[int, ...], scale: float) -> None:
    logits = logits_of(*shape, scale=scale)
    exact, largest = torch.log_softmax(logits.double(), dim=-1), logits.amax(dim=-1, keepdim=True)
    # What is added: a logit, the largest one, the logarithm of a sum of A numbers of up to 1.
    sizes = logits.abs() + largest.abs() + math.log(shape[-1]) + 1.0
    num_roundings = shape[-1] + 12
    found = log_softmax(logits)
    assert_rounded(found, exact, sizes=sizes, num_roundings=num_roundings)
    # What a logarithm is off by, its exponential is off by as a share of itself.
    assert_rounded(found.exp(), exact.exp(), sizes=exact.exp() * sizes, num_roundings=num_roundings)


@pytest.fixture(params=[1, 2, 3], ids="{} threads".format)
def num_threads(request: pytest.FixtureRequest) -> Iterator[int]:
    """PyTorch's threads, among which it divides what it computes."""
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@pytest.mark.usefixtures("num_threads")
@pytest.mark.parametrize("shape", SHAPES)
def test_a_members_are_the_same_beside_others_and_wherever_they_lie(shape: tuple[int, ...]) -> None:
    logits = logits_of(*shape)
    together = log_softmax(logits)
    probabilities = together.exp()
    wider = torch.cat([logits, logits], dim=-1)[..., shape[-1] :]
    assert torch.equal(log_softmax(wider), together)
    for member in range(shape[0]):
        alone = log_softmax(logits[member : member + 1])[0]
        assert torch.equal(alone, together[member])
        assert torch.equal(alone.exp(), probabilities[member])
        assert torch.equal(log_softmax(logits.flip(0))[shape[0] - 1 - member], together[member])


def test_what_is_no_number_stays_in_its_row() -> None:
    logits = logits_of(3, 32, 4)
    whole = log_softmax(logits)
    logits[1, 5, 2], logits[2, 7, 0], logits[0, 9, 3] = torch.nan, torch.inf, FORBIDDEN
    found = log_softmax(logits)
    changed = (found != whole).any(dim=-1)
    assert changed.nonzero().tolist() == [[0, 9], [1, 5], [2, 7]]
    assert found[1, 5].isnan().all()
    assert found[0, 9, 3].exp() == 0.0


def test_rows_are_summed_in_the_order_of_a_row() -> None:
    values = logits_of(6, 80, 7)
    across = values.transpose(-2, -1).contiguous().transpose(-2, -1)
    assert not across.is_contiguous()
    assert torch.equal(sum_of_values(across), values.sum(dim=-1))

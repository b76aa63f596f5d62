"""The probabilities of few values, as most choices of an action have.

PyTorch computes a row at a time. Where that is of fewer numbers than a CPU's vector has, it takes 3 to 9 times as long
as going down the columns, many rows at once (2,560 rows on an AMD EPYC: of 2 values 60 and 11 us, of 6 values 220 and
23). `log_softmax` comes to the same bits either way, as the same functions are applied and numbers are added in the
same order. `torch.softmax` does not, and where PyTorch has several threads it also divides the columns of one member
among them, so what a column comes to depends on how many there are: probabilities are `log_softmax(...).exp()`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from policies.packed.sizes import LINE

_FEW = 8
"""The numbers of float32 in the smaller vectors of today's CPUs; rows of so many are added in another order."""


def log_softmax(logits: Tensor) -> Tensor:
    """Return the log probability of each value, in the shape of the logits, (..., B, A)."""
    num_rows, num_values = logits.shape[-2:]
    # Rows that are left over by whole vectors would be computed by other code, which rounds otherwise.
    if num_values >= _FEW or num_rows % LINE or logits.device.type != "cpu":
        return torch.log_softmax(logits, dim=-1)
    return torch.log_softmax(logits.transpose(-2, -1).contiguous(), dim=-2).transpose(-2, -1)


def sum_of_values(products: Tensor) -> Tensor:
    """Return the sum of each row, (..., B), in the order of a row whichever way the numbers lie."""
    return products.contiguous().sum(dim=-1)

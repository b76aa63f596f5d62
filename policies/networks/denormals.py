"""Numbers next to zero, with which processors compute a hundred times as slowly, count as zero in updates of weights.

The moments of a weight whose gradient is zero, as behind a ReLU that is off, shrink with each update until they are
denormal (below 1.2e-38), and never become zero: 0.9 times the smallest number is rounded to itself. Adam's next
updates then take several times as long. Nothing that they add to a weight could be seen in it: what is taken for zero
is divided by `optimizer_epsilon` or more.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

_SMALLEST = np.array([1], dtype=np.uint32).view(np.float32)
"""The smallest positive float32, by its bits, as computing it may give 0."""


@contextmanager
def denormals_as_zero() -> Iterator[None]:
    """Take denormal numbers for zero in this thread, where the processor can; whoever calls gets back what they had."""
    before = float(_SMALLEST[0]) == 0.0
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)

"""Fixtures of the tests of the command line, of stores, and of those that compute."""

from collections.abc import Iterator

import pytest
from fake_sweeps import run, sweeps
from s3_faults import faults, opened, url
from store_parts import another, harness, sweep, trial

__all__ = ["another", "faults", "harness", "in_double", "opened", "run", "sweep", "sweeps", "trial", "url"]


@pytest.fixture
def in_double() -> Iterator[None]:
    """New tensors are of float64: formulas can be compared without their rounding."""
    import torch

    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)

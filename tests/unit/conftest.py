"""Fixtures of the tests of the command line, and of those that compute."""

import pytest
from fake_sweeps import run, sweeps

__all__ = ["in_double", "run", "sweeps"]


@pytest.fixture
def in_double():
    """New tensors are of float64: formulas can be compared without their rounding."""
    import torch

    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)

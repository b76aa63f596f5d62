"""How population based training changes the searched values of a trial that goes on from another's checkpoint.

As in Jaderberg et al. 2017, "Population Based Training of Neural Networks": a value is drawn anew from its domain or
moved a little from the better trial's, each by itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel

from tune_jobs.spec.domains import Domain, Listed, Range

FACTORS = (0.8, 1.2)
"""What a number is multiplied with if it isn't drawn anew; Jaderberg et al. use these two."""


def mutate(
    point: Mapping[str, Any], space: Mapping[str, Domain], rng: np.random.Generator, resample_probability: float
) -> dict[str, Any]:
    """A point near another, or with some values drawn anew, within the space.

    Args:
        point: Of the better trial.
        space: Domains by hyperparameter.
        rng: Draws everything.
        resample_probability: How likely a value is drawn anew, in [0, 1]; else it becomes a neighbouring one.
    """
    return {
        name: domain.sample(rng) if rng.random() < resample_probability else _neighbour(domain, point[name], rng)
        for name, domain in space.items()
    }


def _neighbour(domain: BaseModel, value: Any, rng: np.random.Generator) -> Any:
    """The value before or after this one in a list, or 0.8 or 1.2 times it; never outside the domain."""
    up = bool(rng.integers(2))
    if isinstance(domain, Listed):
        index = domain.index_of(value) + (1 if up else -1)
        return domain.values[min(max(index, 0), len(domain.values) - 1)]
    assert isinstance(domain, Range)
    moved = value * FACTORS[up]
    low, high = domain.bounds
    if domain.q is None and not domain.is_whole:
        return float(min(max(moved, low), high))
    first, last = domain.factors
    q = domain.q or 1.0
    # At least one step, or a small whole number would stay where it is.
    step = max(round(moved / q), round(value / q) + 1) if up else min(round(moved / q), round(value / q) - 1)
    return domain.at_factor(min(max(step, first), last))

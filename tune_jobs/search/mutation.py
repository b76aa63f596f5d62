"""Mutate points, for trials that continue from another's checkpoint in population based training.

As in Jaderberg et al. 2017, "Population Based Training of Neural Networks", each value is either drawn anew from its
domain or changed a little from the better trial's value.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel

from tune_jobs.spec.conditions import Conditions
from tune_jobs.spec.domains import Domain, Listed, Range
from tune_jobs.spec.ranges import PowerOfTwo

FACTORS = (0.8, 1.2)
"""The factors for a number that isn't drawn anew; Jaderberg et al. use these two."""


def mutate(
    point: Mapping[str, Any], space: Mapping[str, Domain], rng: np.random.Generator, resample_probability: float
) -> dict[str, Any]:
    """Return a point near another, possibly with some values drawn anew, within the space.

    What did not act in the other point, and does in this one, is drawn anew.

    Args:
        point: The better trial's point.
        space: Domains by hyperparameter.
        rng: Draws everything.
        resample_probability: The probability, in [0, 1], that a value is drawn anew and not changed to a neighbour.
    """
    return Conditions(space).stripped(mutate_all(point, space, rng, resample_probability))


def mutate_all(
    point: Mapping[str, Any], space: Mapping[str, Domain], rng: np.random.Generator, resample_probability: float
) -> dict[str, Any]:
    """Return a value of each hyperparameter, also of those that do not act; see `mutate`."""
    return {
        name: domain.sample(rng)
        if rng.random() < resample_probability or name not in point
        else _neighbour(domain, point[name], rng)
        for name, domain in space.items()
    }


def _neighbour(domain: BaseModel, value: Any, rng: np.random.Generator) -> Any:
    """Return the value before or after this one in a list, or 0.8 or 1.2 times it; never outside the domain."""
    up = bool(rng.integers(2))
    if isinstance(domain, Listed):
        index = domain.index_of(value) + (1 if up else -1)
        return domain.values[min(max(index, 0), len(domain.values) - 1)]
    assert isinstance(domain, Range)
    low, high = domain.codes
    if not domain.is_stepped:
        return domain.of_code(min(max(domain.code_of(value) * FACTORS[up], low), high))
    if isinstance(domain, PowerOfTwo):
        return domain.of_code(min(max(domain.code_of(value) + (1 if up else -1), low), high))
    moved = value * FACTORS[up]
    first, last = domain.factors
    q = domain.q or 1.0
    # At least one step, because a small whole number would not change otherwise.
    step = max(round(moved / q), round(value / q) + 1) if up else min(round(moved / q), round(value / q) - 1)
    return domain.at_factor(min(max(step, first), last))

"""Draw the points of a sweep: every combination of the grids' values, and random values of the other domains."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

from policies import random_streams
from tune_jobs.spec.conditions import Conditions, in_order
from tune_jobs.spec.domains import Domain, Grid

_MOST_COMBINATIONS = 1_000_000
"""Of grids with conditions, more than these are not counted; no sweep can have as many."""


def num_points(space: Mapping[str, Domain], num_samples: int) -> int:
    """Return how many points `draw_points` returns; beyond a million it may return less."""
    grids = _grids(space)
    related = {name for name, grid in grids.items() if grid.when} | {
        other for grid in grids.values() for other in grid.when or {}
    }
    alone = math.prod(len(grid.values) for name, grid in grids.items() if name not in related)
    return num_samples * alone * len(_acting_combinations(space, [name for name in grids if name in related]))


def draw_points(space: Mapping[str, Domain], num_samples: int, sweep_seed: int) -> list[dict[str, Any]]:
    """Draw the points of a sweep: for each sample, one for each combination of the grids' values.

    The random values of point i come from a generator of their own, so a point depends on the space, the
    sweep seed and its own index alone: a larger `num_samples` appends points and changes none.

    Args:
        space: Domains by hyperparameter. Their order is the order of the grid (the last one varies fastest). A grid
            may depend on grids only.
        num_samples: How often the whole grid is repeated, each time with new random values.
        sweep_seed: Seed of the sweep, at least 0.

    Returns:
        `num_samples` times the number of combinations points, each a dict in the order of the space. Combinations that
        differ only in values that do not act are one.
    """
    grids = _grids(space)
    if any(grid.when for grid in grids.values()):
        combinations = _acting_combinations(space, list(grids))
    else:
        combinations = [
            dict(zip(grids, values, strict=True))
            for values in itertools.product(*(grid.values for grid in grids.values()))
        ]
    conditions = Conditions(space)
    return [
        _drawn(space, conditions, index, sweep_seed, combination)
        for index, combination in enumerate(combinations * num_samples)
    ]


def draw_point(space: Mapping[str, Domain], index: int, sweep_seed: int) -> dict[str, Any]:
    """Draw only point `index`; values of grids are drawn like those of choices.

    Args:
        space: Domains by hyperparameter.
        index: The index of the point.
        sweep_seed: Seed of the sweep, at least 0.
    """
    return Conditions(space).stripped(draw_all(space, index, sweep_seed))


def draw_all(space: Mapping[str, Domain], index: int, sweep_seed: int) -> dict[str, Any]:
    """Draw the same, with a value of each hyperparameter, also of those that do not act."""
    rng = random_streams.point_values(sweep_seed, index)
    return {name: domain.sample(rng) for name, domain in space.items()}


def _drawn(
    space: Mapping[str, Domain], conditions: Conditions, index: int, sweep_seed: int, combination: Mapping[str, Any]
) -> dict[str, Any]:
    rng = random_streams.point_values(sweep_seed, index)
    values = {}
    for name, domain in space.items():
        if isinstance(domain, Grid):
            if name in combination:
                values[name] = combination[name]
        else:
            # Drawn whether it acts or not, so that a condition changes no other value.
            values[name] = domain.sample(rng)
    return conditions.stripped(values)


def _grids(space: Mapping[str, Domain]) -> dict[str, Grid]:
    return {name: domain for name, domain in space.items() if isinstance(domain, Grid)}


def _acting_combinations(space: Mapping[str, Domain], names: list[str]) -> list[dict[str, Any]]:
    """Return each combination of some grids' values once, without values that do not act, in the order of the grid."""
    grids, conditions = _grids(space), Conditions(space)
    found: list[dict[str, int]] = [{}]
    for name in in_order(space):
        if name in names:
            grown: list[dict[str, int]] = []
            for indexes in found:
                known = {other: grids[other].values[index] for other, index in indexes.items()}
                acts = name in conditions.acting(known)
                grown += [indexes | {name: index} for index in range(len(grids[name].values))] if acts else [indexes]
                if len(grown) >= _MOST_COMBINATIONS:
                    break
            found = grown
    found.sort(key=lambda indexes: [indexes.get(name, -1) for name in names])
    return [{name: grids[name].values[indexes[name]] for name in names if name in indexes} for indexes in found]

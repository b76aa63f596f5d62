"""Draw the points of a sweep: every combination of the grids' values, and random values of the other domains.

No point is drawn twice while there are others: what was drawn before is drawn again, by the same generator. Lists have
few points, and of 20 independent draws of 24 points a third would be trainings of what is known. Other tools draw
independently.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from policies import random_streams
from tune_jobs.spec.conditions import Conditions, in_order
from tune_jobs.spec.domains import Domain, Grid

if TYPE_CHECKING:
    from numpy.random import Generator

MOST_COMBINATIONS = 1_000_000
"""Of grids with conditions, more than these are not counted; no sweep can have as many."""
_MOST_DRAWS = 200
"""So many draws of nothing but what is known, and there are hardly any others; of few known points, fewer."""


def num_points(space: Mapping[str, Domain], num_samples: int, *, most: int = MOST_COMBINATIONS) -> int:
    """Return how many points `draw_points` returns; beyond so many combinations it may return less, but not below."""
    grids = _grids(space)
    return num_samples * _num_combinations(space, {name: grid.values for name, grid in grids.items()}, most)


def num_different(space: Mapping[str, Domain], most: int) -> int | None:
    """Return how many different points a space has; of more than `most`, some number from `most` on, or None.

    None: a domain has more than `most` values, or a range of real numbers.
    """
    values = {}
    for name, domain in space.items():
        listed = domain.all_values(most)
        if listed is None:
            return None
        values[name] = listed
    return _num_combinations(space, values, most)


def draw_points(space: Mapping[str, Domain], num_samples: int, sweep_seed: int) -> list[dict[str, Any]]:
    """Draw the points of a sweep: for each sample, one for each combination of the grids' values.

    The random values of point i come from a generator of their own, and are drawn again if an earlier point has them
    all, so a point depends on the space, the sweep seed and earlier points alone: a larger `num_samples` appends points
    and changes none. Once a combination has hardly any others, all of its points may come a second time, and so on.

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
    return _all_different(space, combinations * num_samples, sweep_seed, len(combinations))


def draw_first_points(space: Mapping[str, Domain], number: int, sweep_seed: int) -> list[dict[str, Any]]:
    """Draw so many points, different as those of `draw_points`; values of grids are drawn like those of choices.

    Args:
        space: Domains by hyperparameter.
        number: How many.
        sweep_seed: Seed of the sweep, at least 0.
    """
    return _all_different(space, [None] * number, sweep_seed, 1)


def draw_point(space: Mapping[str, Domain], index: int, sweep_seed: int) -> dict[str, Any]:
    """Draw only point `index`, whatever the others are; values of grids are drawn like those of choices.

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


def _all_different(
    space: Mapping[str, Domain], combinations: Sequence[Mapping[str, Any] | None], sweep_seed: int, num_groups: int
) -> list[dict[str, Any]]:
    """Draw a point for each combination of the grids' values; None: values of grids are drawn, too.

    Each `num_groups` of them repeat those before.
    """
    conditions = Conditions(space)
    known: list[set[str]] = [set() for _ in range(num_groups)]
    points = []
    for index, combination in enumerate(combinations):
        rng = random_streams.point_values(sweep_seed, index)
        draws = _draws(space, conditions, rng, combination)
        point = next(draws)
        # Where nothing random acts there is one point.
        if combination is None or any(space[name].is_random for name in point):
            point = _unseen(point, draws, known[index % num_groups])
        points.append(point)
    return points


def _unseen(first: dict[str, Any], others: Iterator[dict[str, Any]], seen: set[str]) -> dict[str, Any]:
    """Return a point that is not among those seen, and add it; if there are hardly any others, forget these first."""
    most = min(_MOST_DRAWS, 20 + 8 * len(seen))
    for point in itertools.chain([first], itertools.islice(others, most - 1)):
        if (key := repr(point)) not in seen:
            seen.add(key)
            return point
    seen.clear()
    seen.add(repr(first))
    return first


def _draws(
    space: Mapping[str, Domain], conditions: Conditions, rng: Generator, combination: Mapping[str, Any] | None
) -> Iterator[dict[str, Any]]:
    """Yield random points of a combination without end."""
    while True:
        values = {}
        for name, domain in space.items():
            if combination is not None and isinstance(domain, Grid):
                if name in combination:
                    values[name] = combination[name]
            else:
                # Drawn whether it acts or not, so that a condition changes no other value.
                values[name] = domain.sample(rng)
        yield conditions.stripped(values)


def _grids(space: Mapping[str, Domain]) -> dict[str, Grid]:
    return {name: domain for name, domain in space.items() if isinstance(domain, Grid)}


def _num_combinations(space: Mapping[str, Domain], values: Mapping[str, Sequence[Any]], most: int) -> int:
    """Return how many combinations there are of values by name; beyond `most` it may return less, but not below."""
    # What no condition connects multiplies, so that only the values of one group are listed together.
    groups = _connected({name: space[name] for name in values})
    return math.prod(len(_acting_indexes(space, values, group, most)) for group in groups)


def _connected(domains: Mapping[str, Domain]) -> list[list[str]]:
    """Divide domains into groups between which there is no condition, each in the order of the space."""
    groups: list[set[str]] = []
    for name, domain in domains.items():
        touched = {name, *(other for other in domain.when or {} if other in domains)}
        groups = [group for group in groups if not group & touched] + [
            touched.union(*(group for group in groups if group & touched))
        ]
    return [[name for name in domains if name in group] for group in groups]


def _acting_combinations(space: Mapping[str, Domain], names: list[str]) -> list[dict[str, Any]]:
    """Return each combination of some grids' values once, without values that do not act, in the order of the grid."""
    values = {name: grid.values for name, grid in _grids(space).items()}
    found = _acting_indexes(space, values, names)
    found.sort(key=lambda indexes: [indexes.get(name, -1) for name in names])
    return [{name: values[name][indexes[name]] for name in names if name in indexes} for indexes in found]


def _acting_indexes(
    space: Mapping[str, Domain],
    values: Mapping[str, Sequence[Any]],
    names: Sequence[str],
    most: int = MOST_COMBINATIONS,
) -> list[dict[str, int]]:
    """Return the same in any order, as the places of values in their lists; of too many, some of their beginnings."""
    conditions = Conditions(space)
    found: list[dict[str, int]] = [{}]
    for name in in_order(space):
        if name in names:
            grown: list[dict[str, int]] = []
            for indexes in found:
                known = {other: values[other][index] for other, index in indexes.items()}
                acts = name in conditions.acting(known)
                grown += [indexes | {name: index} for index in range(len(values[name]))] if acts else [indexes]
                if len(grown) >= most:
                    return grown
            found = grown
    return found

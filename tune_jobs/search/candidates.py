"""Find the place of the search space that a model promises most of: random places, and steps away from good ones.

As SMAC does it (Hutter et al. 2011, "Sequential Model-Based Optimization for General Algorithm Configuration", section
4.3): a model is asked of many places at once, as its gradient would be none across lists and steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from policies.errors import SpecError
from tune_jobs.search.asking import Check, Question
from tune_jobs.search.coordinates import Cube

Floats = NDArray[np.float64]
_NUM_RANDOM = 700
_NUM_NEAR = 300
_ROUNDS = 3
_NUM_CHECKED = 100


def best_point(
    cube: Cube,
    question: Question,
    promise: Callable[[Floats], Floats],
    near: Floats,
    *,
    rng: np.random.Generator,
    check: Check,
) -> dict[str, Any]:
    """Return the valid point of the highest promise that was found, and was not tried before if any such was found.

    Args:
        cube: The search space.
        question: What is asked.
        promise: Returns what the model promises of places, by their columns; the higher the better.
        near: Good places, shape (any, num_sides), whose surroundings are looked at more closely.
        rng: Draws the places.
        check: Raises SpecError for a point that is not valid.

    Raises:
        SpecError: None of many points is valid.
    """
    places = np.concatenate([rng.random((_NUM_RANDOM, cube.num_sides)), _steps(cube, near, 0.2, rng)])
    places = _settled(cube, question, places)
    promises = promise(cube.columns(places))
    for width in 0.1 / 4.0 ** np.arange(_ROUNDS):
        leading = places[np.argsort(-promises, kind="stable")[:8]]
        more = _settled(cube, question, _steps(cube, leading, width, rng))
        places, promises = np.concatenate([places, more]), np.concatenate([promises, promise(cube.columns(more))])
    best_first = places[np.argsort(-promises, kind="stable")]
    return _first_valid(cube, question, best_first, rng, check)


def _settled(cube: Cube, question: Question, places: Floats) -> Floats:
    """Return places with the values that points have of what does not act in them; a model would take others for new.

    Which names act is asked once for each combination of values that decide it.
    """
    if question.parts is None:
        return places
    names, usual = list(question.space), question.parts.values_of({})
    deciding = Cube({name: question.space[name] for name in question.parts.deciding})
    sides = places[:, [names.index(name) for name in question.parts.deciding]]
    _, first, kinds = np.unique(deciding.columns(sides), axis=0, return_index=True, return_inverse=True)
    acting = [question.parts.acting(usual | deciding.point(sides[index])) for index in first]
    acts = np.array([[name in each for name in names] for each in acting])
    return np.where(acts[kinds.ravel()], places, cube.units([usual]))


def _steps(cube: Cube, origins: Floats, width: float, rng: np.random.Generator) -> Floats:
    """Return places around some: each differs in one side or in some of them."""
    if not len(origins):
        return origins
    places = origins[np.arange(_NUM_NEAR) % len(origins)]
    shape = places.shape
    share = rng.choice([1.0 / cube.num_sides, 0.3, 1.0], size=(len(places), 1))
    moves = rng.random(shape) < share
    moves[np.arange(len(places)), rng.integers(cube.num_sides, size=len(places))] = True
    sizes = width * np.exp(rng.normal(size=(len(places), 1)) * 0.7)
    moved = places + rng.normal(size=shape) * sizes
    # What lies beyond an end is as far inside of it.
    moved = np.abs(moved)
    moved = np.clip(np.where(moved > 1.0, 2.0 - moved, moved), 0.0, 1.0)
    # Values in no order are each as near as the others, and are kept more often than changed.
    moved = np.where((cube.num_unordered > 0) & (rng.random(shape) < 0.5), rng.random(shape), moved)
    return np.where(moves, moved, places)


def _point_at(cube: Cube, question: Question, place: Floats) -> dict[str, Any]:
    """Return the point at a place, with exactly the values that points have of what does not act in them.

    There and back, a value of a log scale may change in its last digit, so that a tried point would look new.
    """
    point = cube.point(place)
    return point if question.parts is None else question.parts.values_of(question.parts.point_of(point))


def _first_valid(
    cube: Cube, question: Question, places: Floats, rng: np.random.Generator, check: Check
) -> dict[str, Any]:
    tried = [point.point for point in question.known if point.is_own]
    seen: list[dict[str, Any]] = []
    repeated: dict[str, Any] | None = None
    last_error: SpecError | None = None
    skipped = 0
    for place in [*places, *rng.random((_NUM_CHECKED, cube.num_sides))]:
        # Where the best places are not valid, those that are next to them are not, either.
        if skipped < len(seen) // 20:
            skipped += 1
            continue
        skipped = 0
        point = _point_at(cube, question, place)
        # Places of a space with few values are often the same point.
        if point in seen or (point in tried and repeated is not None):
            continue
        seen.append(point)
        try:
            check(point)
        except SpecError as error:
            last_error = error
        else:
            if point not in tried:
                return point
            repeated = point
    if repeated is not None:
        return repeated
    assert last_error is not None
    raise last_error

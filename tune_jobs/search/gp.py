"""Propose points by a Gaussian process of noisy scores, and expected improvement.

What it costs does not grow with the number of points: the settings of the process are found anew only when their number
has grown by a tenth, from the first points alone, so that the same points give the same settings whatever was asked
before; and the process itself is given the best of them, the newest, and some of the others.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from policies import random_streams
from tune_jobs.search.asking import Check, Question
from tune_jobs.search.candidates import best_point
from tune_jobs.search.coordinates import Cube
from tune_jobs.search.fidelity import Lengths
from tune_jobs.search.gaussian_process import Observed, Posterior, Settings, fit
from tune_jobs.search.history import KnownPoint
from tune_jobs.search.improvement import log_expected_improvement
from tune_jobs.search.warped import observed, tried

Floats = NDArray[np.float64]
_MOST_FITTED, _MOST_GIVEN = 120, 240
"""The most points that settings are found by, and that the process is given."""


_MARGIN = 0.1
"""How much better than the best a score has to be to count as improvement, where all scores have a variance of 1."""


def propose(question: Question, check: Check) -> dict[str, Any]:
    """Answer by a Gaussian process; see `tune_jobs.search.asking.Method`.

    Raises:
        SpecError: None of many points is valid.
    """
    cube, lengths = Cube(question.space), Lengths.among(question.known)
    rng = random_streams.model_draws(question.seed, question.index)
    told = lengths.told(question.known)
    settings = _settings(cube, told, lengths)
    seen, units = observed(cube, told, _MOST_GIVEN, lengths)
    awaited = cube.units([point.point for point in question.known if point.is_running])
    if lengths.is_column:
        # Of points, not of what they had at rungs: what is left out here would be proposed again.
        units = tried(cube, question.known, _MOST_GIVEN)
    places = lengths.places(np.concatenate([units, awaited]))
    whole = lengths.of_whole(cube.columns(places))
    posterior = Posterior(
        settings, lengths.groups(cube), seen, lengths.of_whole(cube.columns(awaited)),
        tried=whole if lengths.is_column else None,
    )  # fmt: skip
    # What runs is expected to be as good as the model says: to be equal to it is no improvement.
    expected = posterior.at(whole)[0] if lengths.is_column else posterior.mean_at_given()
    best = float(expected.max()) + _MARGIN
    near = places[np.argsort(-expected, kind="stable")[:10]]

    def promise(columns: Floats) -> Floats:
        return log_expected_improvement(*posterior.at(lengths.of_whole(columns)), best)

    return best_point(cube, question, promise, near, rng=rng, check=check)


def _settings(cube: Cube, known: Sequence[KnownPoint], lengths: Lengths) -> Settings:
    """Return the settings of the process, of the first points that ended, whose number grows by tenths."""
    num_ended = sum(not point.is_running for point in known)
    num_first = _by_tenths(num_ended)
    ended = [point for point in known if not point.is_running]
    first = [point for point in known[:num_first] if not point.is_running]
    seen, _ = observed(cube, first or ended, _MOST_FITTED, lengths)
    groups = tuple(map(int, lengths.groups(cube)))
    return _fitted(seen.columns.tobytes(), seen.means.tobytes(), seen.counts.tobytes(), seen.spread, groups)


def _by_tenths(number: int) -> int:
    """Return the largest number up to this one that is a tenth above the one before it."""
    if number < 100:
        return number - number % max(1, number // 10)
    found = 100
    while (larger := found + found // 10) <= number:
        found = larger
    return found


@functools.lru_cache(maxsize=8)
def _fitted(columns: bytes, means: bytes, counts: bytes, spread: float, group_of_column: tuple[int, ...]) -> Settings:
    """Return the settings that `fit` finds; kept, as finding them takes longer than all else."""
    groups = np.array(group_of_column)
    at = np.frombuffer(columns).reshape(-1, len(groups))
    return fit(Observed(at, np.frombuffer(means), np.frombuffer(counts), spread), groups)

"""Propose points by a random forest of the scores, and expected improvement, as SMAC does.

Hutter et al. 2011, "Sequential Model-Based Optimization for General Algorithm Configuration", with the settings that
SMAC3 2.4 has for hyperparameters: 10 trees that see all columns, of leaves with one point, how far they disagree as the
deviation, and every fifth point at random. The trees are scikit-learn's.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from policies import random_streams
from policies.errors import SpecError
from tune_jobs.search.asking import Check, Question
from tune_jobs.search.candidates import best_point
from tune_jobs.search.coordinates import Cube
from tune_jobs.search.improvement import log_expected_improvement
from tune_jobs.search.warped import observed
from tune_jobs.spec.draws import draw_point

Floats = NDArray[np.float64]
_NUM_TREES = 10
_RANDOM_SHARE = 0.2
_MOST_GIVEN = 400
"""The most points that trees are grown of, as that takes longer the more there are."""
_LEAST_DEVIATION = 0.05


def propose(question: Question, check: Check) -> dict[str, Any]:
    """Answer by a random forest; see `tune_jobs.search.asking.Method`.

    Raises:
        SpecError: None of many points is valid.
    """
    from sklearn.ensemble import RandomForestRegressor

    rng = random_streams.model_draws(question.seed, question.index)
    if rng.random() < _RANDOM_SHARE:
        point = draw_point(question.space, question.index, question.seed)
        if question.parts is not None:
            # With the values that points have of what does not act in them, or one that was tried would look new.
            point = question.parts.values_of(question.parts.point_of(point))
        # One that was tried is no look at anything new, where a space is small.
        if all(item.point != point for item in question.known if item.is_own):
            with suppress(SpecError):
                check(point)
                return point
    cube = Cube(question.space)
    seen, units = observed(cube, question.known, _MOST_GIVEN)
    forest = RandomForestRegressor(_NUM_TREES, random_state=int(rng.integers(2**31)))
    columns, means, weights = seen.columns, seen.means, seen.counts
    running = cube.columns(cube.units([point.point for point in question.known if point.is_running]))
    if len(running):
        # What runs is expected to give what the trees say of it, so that they are sure there.
        forest.fit(columns, means, weights)
        columns = np.concatenate([columns, running])
        means = np.concatenate([means, forest.predict(running)])
        weights = np.concatenate([weights, np.full(len(running), weights.mean())])
    forest.fit(columns, means, weights)

    def trees_say(columns: Floats) -> Floats:
        # The forest's own `predict` begins a thread for each tree, which takes longer than the trees do.
        floats = columns.astype(np.float32)
        return np.stack([tree.tree_.predict(floats)[:, 0] for tree in forest.estimators_])

    expected = trees_say(seen.columns).mean(0)
    best = float(expected.max())

    def promise(columns: Floats) -> Floats:
        said = trees_say(columns)
        return log_expected_improvement(said.mean(0), np.maximum(said.std(0), _LEAST_DEVIATION), best)

    near = units[np.argsort(-expected, kind="stable")[:10]]
    return best_point(cube, question, promise, near, rng=rng, check=check)

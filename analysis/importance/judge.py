"""Say what mattered in a sweep: importance, effects, joint effects, and ends that are worth moving."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from analysis.importance.answer import Importance, WhatMattered
from analysis.importance.chance import term_chances
from analysis.importance.edges import find_edges
from analysis.importance.effects import adjusted_effects, plain_effects
from analysis.importance.joint import find_interactions
from analysis.importance.model import Fit, Floats, Terms, fit, fit_weighted, make_terms, ranks
from analysis.importance.scored import Scored, score_points
from analysis.importance.searched import Searched, searched
from analysis.records import IterationRecord, SweepRecord, TrialRecord
from analysis.wording import counted
from policies import random_streams

_NUM_RESAMPLES = 200
_NUM_ITERATIONS = 40
"""Of a fit to resampled points, which starts where that to all points ended."""
_LEVEL = 0.05
_LEAST_POINTS = 8
_MOST_POINTS = 500


def what_mattered(
    sweep: SweepRecord,
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    *,
    threshold: float | None = None,
) -> WhatMattered:
    """Say what a sweep's scores depended on; the same records always give the same answer.

    Args:
        sweep: The sweep's record.
        trials: Its trials, in any status.
        results: Iterations by trial id, oldest first.
        threshold: The env's own threshold, for the objective `steps_to_threshold` without one.
    """
    scored = _sampled(score_points(sweep, trials, results, threshold))
    points = scored.points or tuple(trial.point for trial in trials)
    hyperparams = searched(sweep.spec.get("space"), points)
    varied = [item for item in hyperparams if not item.is_constant]
    too_few = scored.why_none or _too_few(scored, varied)
    answer = WhatMattered(
        objective=scored.objective,
        num_points=len(scored.scores),
        num_trials=scored.num_trials,
        hyperparams=tuple(Importance(item.name, None, None, None, is_clear=False) for item in hyperparams),
        too_few=too_few,
        notes=scored.notes,
        num_env_steps=scored.num_env_steps,
    )
    if too_few:
        return dataclasses.replace(answer, effects=tuple(plain_effects(varied, scored.scores) if scored.scores else ()))
    rng = random_streams.fixed()
    terms, outcome = make_terms(varied), ranks(scored.scores)
    fitted = fit(terms, outcome)
    importances = _importances(terms, outcome, fitted, rng)
    constant = [item for item in answer.hyperparams if item.name not in terms.names]
    clear = {item.name for item in importances if item.is_clear}
    effects = {effect.name: effect for effect in adjusted_effects(varied, terms, scored.scores)}
    return dataclasses.replace(
        answer,
        hyperparams=(*importances, *constant),
        effects=tuple(effects[item.name] for item in importances),
        interactions=tuple(find_interactions(terms, fitted, outcome, rng, _LEVEL)),
        edges=tuple(find_edges([item for item in varied if item.name in clear], terms, fitted, outcome, sweep.spec)),
        too_few=_nothing_clear(importances, len(outcome)),
    )


def _importances(terms: Terms, outcome: Floats, fitted: Fit, rng: np.random.Generator) -> list[Importance]:
    """Return the importance of each term, the clear ones first, then by their shares."""
    chances = term_chances(terms, outcome, rng)
    low, high = np.quantile(resampled_shares(terms, outcome, fitted, rng), [0.025, 0.975], axis=0)
    found = [
        # Terms of which values were drawn together can have more variance than their sum.
        Importance(name, _share(share), _share(min(share, lower)), _share(max(share, upper)), is_clear=chance <= _LEVEL)
        for name, share, lower, upper, chance in zip(
            terms.names, fitted.shares[0].tolist(), low.tolist(), high.tolist(), chances.tolist(), strict=True
        )
    ]
    return sorted(found, key=lambda item: (not item.is_clear, -(item.share or 0.0)))


def resampled_shares(terms: Terms, outcome: Floats, fitted: Fit, rng: np.random.Generator) -> Floats:
    """Return the shares that samples of the points give, drawn with replacement; shape (samples, terms)."""
    size = len(outcome)
    weights = rng.multinomial(size, np.full(size, 1.0 / size), size=_NUM_RESAMPLES).astype(np.float64)
    return fit_weighted(terms, outcome, weights, fitted, _NUM_ITERATIONS).shares


def _share(value: float) -> float:
    return round(min(max(value, 0.0), 1.0), 6)


def _nothing_clear(importances: Sequence[Importance], num_points: int) -> str:
    if any(item.is_clear for item in importances):
        return ""
    return (
        f"{num_points:,} points are too few to say what mattered: by chance alone, hyperparameters that change "
        "nothing would often seem to matter as much."
    )


def _sampled(scored: Scored) -> Scored:
    """Return so many points that they are judged in a second."""
    total = len(scored.scores)
    if total <= _MOST_POINTS:
        return scored
    chosen = np.sort(random_streams.fixed().permutation(total)[:_MOST_POINTS])
    return dataclasses.replace(
        scored,
        points=tuple(scored.points[index] for index in chosen),
        scores=tuple(scored.scores[index] for index in chosen),
        notes=(*scored.notes, f"{_MOST_POINTS:,} of the {total:,} points are judged, drawn at random."),
    )


def _too_few(scored: Scored, varied: Sequence[Searched]) -> str:
    if len(scored.scores) < 2:
        return "One point alone was tried: nothing can be compared."
    if not varied:
        return "Every hyperparameter has one value alone: nothing was varied."
    if np.ptp(scored.scores) == 0:
        return "All points score the same."
    if len(scored.scores) < _LEAST_POINTS:
        return (
            f"{counted(len(scored.scores), 'point')} are too few to say what mattered; {_LEAST_POINTS} may be enough."
        )
    return ""

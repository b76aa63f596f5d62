"""How often chance alone would give as much: tests of one term against a model without it.

The score test of a variance component: how much of the outcome, decorrelated by the model without the term, lies along
the term's columns. Its distribution under chance comes from permutations of the decorrelated outcome, so it holds for
outcomes with many ties too. `python tests/unit/simulated_searches.py` prints how often it errs.

Sources: Lin 1997, "Variance Component Testing in Generalised Linear Models with Random Effects"; Freedman & Lane 1983,
"A Nonstochastic Interpretation of Reported Significance Levels"; Holm 1979, "A Simple Sequentially Rejective Multiple
Test Procedure".
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.importance.model import Fit, Floats, Terms, fit

NUM_PERMUTATIONS = 999


def term_chances(terms: Terms, outcome: Floats, rng: np.random.Generator) -> Floats:
    """Return for each term how often chance alone would give as much or more, for all terms together."""
    orders = _orders(len(outcome), rng)
    values = []
    for index in range(len(terms.names)):
        others = terms.without(index)
        fitted = fit(others, outcome) if others.names else None
        values.append(_chance(others, fitted, terms.of(index), outcome, orders))
    return holm(values)


def added_chances(
    terms: Terms, fitted: Fit, added: Sequence[Floats], outcome: Floats, rng: np.random.Generator
) -> Floats:
    """Return the same for terms that might be added to a model, all of them against the model as it is."""
    orders = _orders(len(outcome), rng)
    return holm([_chance(terms, fitted, columns, outcome, orders) for columns in added])


def _orders(size: int, rng: np.random.Generator) -> np.ndarray:
    return np.argsort(rng.random((size, NUM_PERMUTATIONS)), axis=0)


def _chance(terms: Terms, fitted: Fit | None, columns: Floats, outcome: Floats, orders: np.ndarray) -> float:
    rest = (outcome - outcome.mean())[:, np.newaxis]
    if fitted is not None:
        scale = np.sqrt(fitted.variances[0][terms.owners] / fitted.noise[0])
        left, values, _ = np.linalg.svd(terms.columns * scale, full_matrices=False)
        shrink = 1.0 / np.sqrt(1.0 + values**2) - 1.0
        rest = rest + left @ (shrink[:, np.newaxis] * (left.T @ rest))
        columns = columns + left @ (shrink[:, np.newaxis] * (left.T @ columns))
    along = float(((columns.T @ rest) ** 2).sum())
    by_chance = ((columns.T @ rest[:, 0][orders]) ** 2).sum(axis=0)
    return float((1 + (by_chance >= along * (1 - 1e-9)).sum()) / (1 + orders.shape[1]))


def holm(chances: Sequence[float]) -> Floats:
    """Return probabilities that hold for all of several tests together."""
    values = np.asarray(chances, dtype=np.float64)
    order = np.argsort(values, kind="stable")
    raised = np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1))
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(raised, 1.0)
    return adjusted

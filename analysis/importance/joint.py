"""Pairs of hyperparameters that matter together: what the one does depends on the value of the other."""

from __future__ import annotations

import itertools

import numpy as np

from analysis.importance.answer import Interaction
from analysis.importance.chance import added_chances
from analysis.importance.model import Fit, Floats, Terms, centred, fit, joined

_LEAST_PRODUCT = 1e-12
_MOST_PAIRS = 5
"""How many pairs are given at most."""


def find_interactions(
    terms: Terms, fitted: Fit, outcome: Floats, rng: np.random.Generator, level: float
) -> list[Interaction]:
    """Return the pairs that account for more than chance would, beyond what each hyperparameter does by itself.

    Args:
        terms: The model of main effects.
        fitted: Its fit.
        outcome: What it was fitted to.
        rng: For the permutations.
        level: How often a pair may be named by chance, in all pairs together.
    """
    pairs = list(itertools.combinations(range(len(terms.names)), 2))
    # Main effects take as many coefficients; with few more points than these, nothing is left to be seen.
    if not pairs or len(outcome) < 2 * terms.columns.shape[1]:
        return []
    columns = [_product(terms, *pair) for pair in pairs]
    # One of the pair acts with one value of the other alone: there is nothing that both do together.
    seen = [float((product**2).sum()) > _LEAST_PRODUCT * len(outcome) for product in columns]
    pairs = [pair for pair, is_seen in zip(pairs, seen, strict=True) if is_seen]
    columns = [product for product, is_seen in zip(columns, seen, strict=True) if is_seen]
    if not pairs:
        return []
    chances = added_chances(terms, fitted, columns, outcome, rng)
    found: list[Interaction] = []
    for pair, product, chance in sorted(zip(pairs, columns, chances, strict=True), key=lambda item: float(item[2])):
        if chance <= level and len(found) < _MOST_PAIRS:
            main = {name: terms.of(index) for index, name in enumerate(terms.names)}
            share = float(fit(joined(main | {"": product}), outcome).shares[0, -1])
            found.append(Interaction((terms.names[pair[0]], terms.names[pair[1]]), share, is_clear=True))
    return sorted(found, key=lambda item: -item.share)


def _product(terms: Terms, first: int, second: int) -> Floats:
    """Return the products of two terms' columns, less what main effects explain of them."""
    left, right = terms.of(first), terms.of(second)
    products = centred((left[:, :, np.newaxis] * right[:, np.newaxis, :]).reshape(len(left), -1))
    basis, values, _ = np.linalg.svd(terms.columns, full_matrices=False)
    basis = basis[:, values > 1e-8 * values.max()]
    return centred(products - basis @ (basis.T @ products))

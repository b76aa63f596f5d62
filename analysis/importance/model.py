"""A model of the scores with main effects: a sum of one term for each hyperparameter, whose sizes are learnt from data.

A hyperparameter whose values are listed has one coefficient for each value; a number has two, of a parabola on the
scale that it was searched on, as learning rates mostly have a best value with worse ones on both sides. The
coefficients of a term are random with a variance of their own, so that with few points the terms that show nothing are
drawn to zero, and don't take away what others explain. The outcome is the rank of a point's score, so that no outlier
decides. The variances are estimated by restricted maximum likelihood, which needs no tuning.

Sources: Patterson & Thompson 1971, "Recovery of Inter-Block Information when Block Sizes are Unequal", for REML; Zhou,
Hu, Zhou & Lange 2019, "MM Algorithms for Variance Components Models", for the iterations that find it; Robinson 1991,
"That BLUP is a Good Thing", for the terms; Conover & Iman 1981, "Rank Transformations as a Bridge Between Parametric
and Nonparametric Statistics".
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from analysis.importance.searched import Searched

Floats = NDArray[np.float64]
Ints = NDArray[np.int_]
_MOST_LEVELS = 8
"""Of more values than these in a list, the rarest are judged as one."""
_NUM_ITERATIONS = 200
_LEAST_NOISE = 1e-3
"""As a share of the outcome's variance; without any, a model with as many coefficients as points would be certain."""


@dataclass(frozen=True)
class Terms:
    """The columns of a model, those of all terms side by side, each with mean zero."""

    names: tuple[str, ...]
    columns: Floats
    """Shape (points, coefficients); the squares of a term's columns add up to the number of points."""
    owners: Ints
    """The term that each column is of."""

    def without(self, index: int) -> Terms:
        """Return the model without one term."""
        kept = self.owners != index
        names = tuple(name for number, name in enumerate(self.names) if number != index)
        owners = self.owners[kept]
        return Terms(names, self.columns[:, kept], owners - (owners > index))

    def of(self, index: int) -> Floats:
        """Return the columns of one term."""
        chosen: Floats = self.columns[:, self.owners == index]
        return chosen

    @cached_property
    def indicator(self) -> Floats:
        """Which column is of which term, shape (coefficients, terms)."""
        owned: Floats = (self.owners[:, np.newaxis] == np.arange(len(self.names))).astype(np.float64)
        return owned


@dataclass(frozen=True)
class Fit:
    """One fit for each of some outcomes, or samples of the points; they come first in every shape."""

    variances: Floats
    """The variance that each term gives the outcome. Shape (fits, terms)."""
    noise: Floats
    """The variance that no term explains. Shape (fits,)."""
    coefficients: Floats
    """Shape (fits, coefficients)."""
    shares: Floats
    """The variance of each term, as it is fitted, as a share of the outcome's. Shape (fits, terms)."""


def make_terms(hyperparams: Sequence[Searched]) -> Terms:
    """Return the model's terms for hyperparameters that have two values or more."""
    return joined({item.name: columns_of(item) for item in hyperparams})


def joined(columns: dict[str, Floats]) -> Terms:
    """Return the model of terms with these columns, which have mean zero."""
    scaled = [term * np.sqrt(len(term) / max(float((term**2).sum()), 1e-300)) for term in columns.values()]
    owners = np.repeat(np.arange(len(scaled)), [term.shape[1] for term in scaled])
    return Terms(tuple(columns), np.hstack(scaled), owners)


def columns_of(item: Searched) -> Floats:
    """Return a hyperparameter's columns, shape (points, coefficients), each with mean zero.

    Those of points in which it does not act are zero, and the others have mean zero by themselves. So a hyperparameter
    that acts with some values of another takes no part in what that one explains.
    """
    if item.acts is not None:
        acts = ~item.is_idle
        columns = columns_of(dataclasses.replace(item, values=item.acting_values, acts=None))
        whole = np.zeros((len(acts), columns.shape[1]))
        whole[acts] = columns
        return whole
    if item.is_numeric:
        numbers, missing = item.scaled(), item.is_missing
        # Points without a number have a coefficient of their own, and no part in the parabola.
        numbers[missing] = numbers[~missing].mean()
        line = centred(numbers[:, np.newaxis])
        line /= max(float(np.abs(line).max()), 1e-300)
        curve = centred(line**2)
        # What the parabola adds to the line.
        curve -= line * float((line * curve).sum() / max(float((line**2).sum()), 1e-300))
        size = np.sqrt(float((line**2).sum()) / max(float((curve**2).sum()), 1e-12))
        absent = centred(missing[:, np.newaxis].astype(np.float64))
        return np.hstack([line, curve * min(size, 1e6), *([absent] if missing.any() else [])])
    keys = np.array(item.keys)
    levels, counts = np.unique(keys, return_counts=True)
    order = np.argsort(-counts, kind="stable")[:_MOST_LEVELS]
    return centred(np.column_stack([keys == level for level in levels[order]]).astype(np.float64))


def centred(columns: Floats) -> Floats:
    """Return columns less their means."""
    shifted: Floats = columns - columns.mean(axis=0)
    return shifted


def ranks(scores: Sequence[float]) -> Floats:
    """Return the ranks of scores from 0 to 1; equal ones have their mean rank."""
    values = np.asarray(scores, dtype=np.float64)
    order = np.sort(values)
    low, high = np.searchsorted(order, values, "left"), np.searchsorted(order, values, "right")
    scaled: Floats = (low + high - 1) / 2.0 / max(1, len(values) - 1)
    return scaled


def fit(terms: Terms, outcome: Floats) -> Fit:
    """Fit the model to the outcome of each point."""
    return fit_weighted(terms, outcome, np.ones((1, len(outcome))), None, _NUM_ITERATIONS)


def fit_weighted(terms: Terms, outcome: Floats, weights: Floats, start: Fit | None, num_iterations: int) -> Fit:
    """Fit the model to samples of the points, all at once.

    Args:
        terms: The model.
        outcome: One number a point. Shape (points,).
        weights: How often each point is in each sample; they sum to the number of points. Shape (fits, points).
        start: The fit to all points, from which the variances start; None: from equal ones.
        num_iterations: How often they are improved.
    """
    size, columns = len(outcome), terms.columns
    means, mean = weights @ columns / size, weights @ outcome / size
    gram = np.einsum("fp,pi,pj->fij", weights, columns, columns, optimize=True)
    gram -= size * means[:, :, np.newaxis] * means[:, np.newaxis, :]
    along = (weights * outcome) @ columns - size * means * mean[:, np.newaxis]
    total = np.maximum((weights * outcome**2).sum(axis=1) - size * mean**2, 1e-12)
    spread = total / size
    if start is None:
        variances = np.repeat(spread[:, np.newaxis] / (len(terms.names) + 1), len(terms.names), axis=1)
        noise = spread / 2.0
    else:
        variances = np.repeat(start.variances, len(weights), axis=0)
        noise = np.repeat(start.noise, len(weights))
    for _ in range(num_iterations):
        inner = _inner(terms, gram, variances, noise)
        mixed = gram @ inner
        explained = _times(inner, along)
        # The gradient of the likelihood, by Woodbury's identity in the space of the coefficients.
        scores = along / noise[:, np.newaxis] - _times(gram, explained)
        widths = np.diagonal(gram, axis1=1, axis2=2) / noise[:, np.newaxis] - np.einsum("fij,fji->fi", mixed, gram)
        rest = total / noise**2 - 2.0 * (along * explained).sum(axis=1) / noise
        rest += (explained * _times(gram, explained)).sum(axis=1)
        trace = (size - 1) / noise - np.trace(mixed, axis1=1, axis2=2)
        growth = (scores**2 @ terms.indicator) / np.maximum(widths @ terms.indicator, 1e-12)
        variances = variances * np.sqrt(growth)
        variances = np.clip(variances, 1e-9 * spread[:, np.newaxis], 4.0 * spread[:, np.newaxis])
        noise = noise * np.sqrt(np.maximum(rest, 0.0) / np.maximum(trace, 1e-12))
        noise = np.clip(noise, _LEAST_NOISE * spread, 4.0 * spread)
    coefficients = _times(_inner(terms, gram, variances, noise), along) * noise[:, np.newaxis]
    shares = [
        np.einsum("fi,fij,fj->f", coefficients[:, own], gram[:, own][:, :, own], coefficients[:, own])
        for own in (terms.owners == index for index in range(len(terms.names)))
    ]
    return Fit(variances, noise, coefficients, np.stack(shares, axis=1) / total[:, np.newaxis])


def _inner(terms: Terms, gram: Floats, variances: Floats, noise: Floats) -> Floats:
    """Return the coefficients' covariance once the outcome is known, over the square of the noise."""
    scale = np.sqrt(variances[:, terms.owners])
    left, right = scale[:, :, np.newaxis], scale[:, np.newaxis, :]
    system = np.eye(len(terms.owners)) + left * gram * right / noise[:, np.newaxis, np.newaxis]
    found: Floats = left * np.linalg.inv(system) * right / (noise**2)[:, np.newaxis, np.newaxis]
    return found


def _times(matrices: Floats, vectors: Floats) -> Floats:
    product: Floats = (matrices @ vectors[:, :, np.newaxis])[:, :, 0]
    return product

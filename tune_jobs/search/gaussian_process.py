"""A Gaussian process of noisy scores: a Matern 5/2 kernel with a length scale for each name, and one noise for all.

Several scores of a point are repeats of it. Their mean has a part of the noise, and their spread tells how large it is;
what is computed is exactly what each score by itself would give (Binois et al. 2018, "Practical Heteroscedastic
Gaussian Process Modeling for Large Simulation Experiments", section 2), with a matrix of points instead of one of
scores.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_SQRT5 = math.sqrt(5.0)
_JITTER = 1e-6
_NEARLY_THE_SAME = 1e-4
"""Of the function's variance, what stays unknown at a point that was tried."""


@dataclass(frozen=True)
class Observed:
    """Points and the scores that were seen there."""

    columns: Floats
    """Shape (num_points, num_columns)."""
    means: Floats
    """The mean score of each point, shape (num_points,)."""
    counts: Floats
    """How many scores each point has, at least 1, shape (num_points,)."""
    spread: float
    """The sum of the squared differences of all scores from the mean of their point."""


@dataclass(frozen=True)
class Settings:
    """The settings of a process, those that are most likely given some observations."""

    length_scales: Floats
    """Of each group of columns."""
    scale: float
    """The variance of the function."""
    noise: float
    """The variance of one score around it."""


def fit(observed: Observed, group_of_column: NDArray[np.int64], *, max_steps: int = 40) -> Settings:
    """Return the most likely settings, given what is expected of them before anything is seen.

    Args:
        observed: What was seen.
        group_of_column: Which columns have one length scale, from 0.
        max_steps: How many steps the search for them takes at most.
    """
    from scipy.optimize import minimize

    num_groups = int(group_of_column.max()) + 1
    expected, width = _expected(num_groups)
    squares = _squares_by_group(observed.columns, group_of_column, num_groups)
    found = minimize(
        _loss, expected, args=(observed, squares, expected, width), jac=True, method="L-BFGS-B",
        bounds=[(centre - 5.0, centre + 5.0) for centre in expected], options={"maxiter": max_steps},
    )  # fmt: skip
    values = np.exp(found.x)
    return Settings(values[:num_groups], float(values[num_groups]), float(values[num_groups + 1]))


def _expected(num_groups: int) -> tuple[Floats, Floats]:
    """Return the logarithms of the settings that are expected, and how far off they may be.

    What is good of a hyperparameter is usually about a quarter of its range. Where longer scales are expected, as for
    other tasks (Hvarfner et al. 2024, "Vanilla Bayesian Optimization Performs Great in High Dimensions"), the search
    ends in the corners of the space while few points are known (decision 40).
    """
    centres = np.array([*[-0.5] * num_groups, 0.0, math.log(0.2)])
    return centres, np.array([*[0.7] * num_groups, 0.5, 1.0])


def _squares_by_group(columns: Floats, group_of_column: NDArray[np.int64], num_groups: int) -> Floats:
    """Return squared distances by group, shape (num_groups, num_points, num_points)."""
    squares = np.zeros((num_groups, len(columns), len(columns)))
    for column, group in enumerate(group_of_column):
        values = columns[:, column]
        squares[group] += (values[:, None] - values[None, :]) ** 2
    return squares


def _loss(logs: Floats, observed: Observed, squares: Floats, expected: Floats, width: Floats) -> tuple[float, Floats]:
    """Return minus the logarithm of how likely settings are, and its gradient."""
    num_points, num_groups = len(observed.means), len(squares)
    weights = np.exp(-2.0 * logs[:num_groups])
    scale, noise = math.exp(logs[num_groups]), math.exp(logs[num_groups + 1])
    distance = np.sqrt(np.tensordot(weights, squares, axes=1))
    decay = np.exp(-_SQRT5 * distance)
    kernel = scale * (1.0 + _SQRT5 * distance + 5.0 / 3.0 * distance**2) * decay
    own = noise / observed.counts
    # No matrix is singular with the noise that is possible here.
    lower = np.linalg.cholesky(kernel + np.diag(own + _JITTER))
    inverse = np.linalg.inv(lower)
    inverse = inverse.T @ inverse
    alpha = inverse @ observed.means
    repeats = float(observed.counts.sum()) - num_points
    loss = (
        0.5 * float(observed.means @ alpha)
        + float(np.log(np.diag(lower)).sum())
        + 0.5 * (repeats * math.log(noise) + observed.spread / noise)
        + 0.5 * float((((logs - expected) / width) ** 2).sum())
    )
    # d loss / d K = (K^-1 - alpha alpha^T) / 2
    slope = 0.5 * (inverse - np.outer(alpha, alpha))
    by_square = slope * (scale * 5.0 / 3.0) * (1.0 + _SQRT5 * distance) * decay
    gradient = np.empty_like(logs)
    # d kernel / d log(length) = 5/3 scale (1 + sqrt5 r) exp(-sqrt5 r) square / length^2
    gradient[:num_groups] = weights * np.tensordot(squares, by_square, axes=([1, 2], [0, 1]))
    gradient[num_groups] = float((slope * kernel).sum())
    gradient[num_groups + 1] = float((np.diag(slope) * own).sum()) + 0.5 * (repeats - observed.spread / noise)
    return loss, gradient + (logs - expected) / width**2


class Posterior:
    """What a process says of any point, after observations.

    What it expects takes the scores for as noisy as they are. How far off that may be is told as if there were no
    noise: then nothing is to be gained where a point was tried, whatever its scores, and a search goes on to other
    places ("re-interpolation": Forrester et al. 2006, "Design and Analysis of 'Noisy' Computer Experiments"). With the
    noise in it, the search stays around the luckiest score (decision 40).

    Args:
        settings: The settings of the process.
        group_of_column: Which columns have one length scale, from 0.
        observed: What was seen.
        awaited: Points whose scores are not known yet, shape (any, num_columns). They make the process surer of their
            surroundings, but don't change what it expects there (Desautels et al. 2014, "Parallelizing Exploration-
            Exploitation Tradeoffs with Gaussian Process Bandit Optimization").
        tried: Where nothing is to be gained any more, shape (any, num_columns); None: at the observed and the awaited
            points. Of trainings of several lengths it is each point as a whole training: one that was ended early would
            be proposed again and again, as nothing is known of its end.
    """

    def __init__(
        self, settings: Settings, group_of_column: NDArray[np.int64], observed: Observed, awaited: Floats,
        tried: Floats | None = None,
    ) -> None:  # fmt: skip
        self._settings = settings
        self._by_length = 1.0 / settings.length_scales[group_of_column]
        self._num_observed = len(observed.means)
        self._seen = np.concatenate([observed.columns, awaited]) * self._by_length
        kernel = self._kernel(self._seen, self._seen)
        first = kernel[: self._num_observed, : self._num_observed] + np.diag(settings.noise / observed.counts + _JITTER)
        inverse = np.linalg.inv(np.linalg.cholesky(first))
        self._alpha = inverse.T @ (inverse @ observed.means)
        self._tried = None if tried is None else tried * self._by_length
        if self._tried is not None:
            kernel = self._kernel(self._tried, self._tried)
        # Places that are nearly the same would make the matrix singular.
        apart = _NEARLY_THE_SAME * settings.scale * np.eye(len(kernel))
        self._inverse = np.linalg.inv(np.linalg.cholesky(kernel + apart))

    def _kernel(self, left: Floats, right: Floats) -> Floats:
        squares = (left**2).sum(1)[:, None] + (right**2).sum(1)[None, :] - 2.0 * (left @ right.T)
        # In place: of a thousand places at a time, new arrays take longer than what is computed.
        scaled = np.sqrt(np.maximum(squares, 0.0, out=squares), out=squares)
        scaled *= _SQRT5
        kernel: Floats = scaled**2
        kernel /= 3.0
        kernel += 1.0 + scaled
        kernel *= self._settings.scale
        kernel *= np.exp(np.negative(scaled, out=scaled), out=scaled)
        return kernel

    def mean_at_given(self) -> Floats:
        """Return what is expected at the observed points, and behind them at those that are awaited."""
        expected: Floats = self._kernel(self._seen, self._seen[: self._num_observed]) @ self._alpha
        return expected

    def at(self, columns: Floats) -> tuple[Floats, Floats]:
        """Return what is expected of points and how far off that may be, as deviation, each of shape (num_points,)."""
        places = columns * self._by_length
        kernel = self._kernel(places, self._seen)
        mean = kernel[:, : self._num_observed] @ self._alpha
        if self._tried is not None:
            kernel = self._kernel(places, self._tried)
        variance = self._settings.scale - ((kernel @ self._inverse.T) ** 2).sum(1)
        return mean, np.sqrt(np.maximum(variance, 1e-12))

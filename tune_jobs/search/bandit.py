"""Choose values for the next interval of a population's trial by what such intervals have gained (PB2).

As in Parker-Holder et al. 2020, "Provably Efficient Online Hyperparameter Optimization with Population-Based Bandits":
a Gaussian process models what an interval gains by the values it was trained with, the score it began at, and when it
was, as what is good early need not be later. The values are those of the greatest upper confidence bound (GP-UCB), with
intervals that others train meanwhile counted in the variance (GP-BUCB, Desautels et al. 2014). Only ranges are chosen
so; lists mutate as in population based training, and so does everything as long as nothing is known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tune_jobs.search.mutation import mutate_all
from tune_jobs.search.one_thread import one_thread
from tune_jobs.search.parts import Parts
from tune_jobs.spec.conditions import Conditions
from tune_jobs.spec.domains import Domain, Range

Floats = NDArray[np.float64]

MOST_INTERVALS = 96
"""The intervals nearest in time that the model is made of; others say little about what is good now."""
_LENGTH_SCALES = (0.15, 0.3, 0.6, 1.2)
"""Of values and scores, which are scaled to [0, 1]."""
_FORGETTING = (0.0, 0.03, 0.1, 0.3)
"""How much less an interval says of the next one than of itself: epsilon of the time-varying kernel."""
_NOISES = (0.03, 0.1, 0.3, 1.0)
"""Variances of the noise beside that of the gains, which are standardised."""
_FIRST_BETA, _BETA_RATE = 0.2, 0.4
"""The paper's c1 and c2: beta is c1 + log(c2 * t), of t intervals."""
_NUM_CANDIDATES, _NUM_NEAR = 300, 100
_MOST = 2.0
"""Standardised gains beyond this many deviations count as this many, as one collapse must not be all that is seen."""
_MOST_LOSS = 16.0
"""A loss counts for at most so many times the greatest gain: else a collapse to minus a million is the deviation."""


@dataclass(frozen=True)
class Gain:
    """An interval that a trial has trained with one point."""

    time: float
    """When it ended, counted in intervals."""
    before: float
    """The score that it began at."""
    gain: float
    """By how much the score rose in it, for each interval's length."""
    point: Mapping[str, Any]


@dataclass(frozen=True)
class Next:
    """The interval for which values are chosen."""

    time: float
    before: float
    point: Mapping[str, Any]
    """The point that the better trial had in its last one."""
    meanwhile: Sequence[Mapping[str, Any]]
    """The points that other trials train with at the same time."""


@one_thread()
def propose(
    coming: Next,
    space: Mapping[str, Domain],
    gains: Sequence[Gain],
    rng: np.random.Generator,
    resample_probability: float,
) -> dict[str, Any]:
    """Return the point for an interval.

    Args:
        coming: The interval.
        space: Domains by hyperparameter.
        gains: What is known, in any order.
        rng: Draws the mutation of lists, and the candidates.
        resample_probability: Of the mutation; see `tune_jobs.search.mutation.mutate`.
    """
    mutated = mutate_all(coming.point, space, rng, resample_probability)
    parts = Parts(space)
    ranges = {name: domain for name, domain in parts.space.items() if isinstance(domain, Range)}
    known = _nearest(gains, coming.time)
    if not ranges or len(known) < 2:
        return Conditions(space).stripped(mutated)
    scale = _Scale(ranges, parts, [one.before for one in known])
    rows = scale.rows([one.before for one in known], [one.point for one in known])
    model = _Model.fitted(np.array([one.time for one in known]), rows, np.array([one.gain for one in known]))
    candidates = scale.candidates(coming, rng)
    meanwhile = scale.rows([coming.before] * len(coming.meanwhile), coming.meanwhile)
    bounds = model.upper_bounds(coming.time, scale.beside(coming.before, candidates), meanwhile)
    best = candidates[int(np.argmax(bounds))]
    # Stripped now, as it depends on the ranges' new values too which of the lists act.
    return parts.point_of(parts.values_of(mutated) | scale.values(best))


def _nearest(gains: Sequence[Gain], time: float) -> list[Gain]:
    """Return the intervals that are nearest to a time, the oldest first.

    Usually these are the newest, but trials that are added to a population have its later intervals ahead of them.
    """
    known = sorted(gains, key=lambda one: one.time)
    first, end = 0, len(known)
    while end - first > MOST_INTERVALS:
        if time - known[first].time >= known[end - 1].time - time:
            first += 1
        else:
            end -= 1
    return known[first:end]


class _Scale:
    """Points as rows of numbers in [0, 1], one for each range, behind the score before."""

    def __init__(self, ranges: Mapping[str, Range], parts: Parts, scores: Sequence[float]) -> None:
        self._ranges, self._parts = ranges, parts
        self._low, self._width = min(scores), (max(scores) - min(scores)) or 1.0

    def rows(self, before: Sequence[float], points: Sequence[Mapping[str, Any]]) -> Floats:
        """Return (points, 1 + ranges)."""
        units = [
            [_unit(domain, values[name]) for name, domain in self._ranges.items()]
            for values in map(self._parts.values_of, points)
        ]
        table = np.array(units, dtype=np.float64).reshape(len(points), len(self._ranges))
        scores = (np.array(before, dtype=np.float64) - self._low) / self._width
        return np.column_stack([scores, table])

    def beside(self, before: float, units: Floats) -> Floats:
        """Return candidates as rows."""
        return np.column_stack([np.full(len(units), (before - self._low) / self._width), units])

    def candidates(self, coming: Next, rng: np.random.Generator) -> Floats:
        """Return values from all of the ranges, and from near those of the better trial."""
        anywhere = rng.random((_NUM_CANDIDATES, len(self._ranges)))
        present = self.rows([coming.before], [coming.point])[:, 1:]
        near = present + 0.1 * rng.standard_normal((_NUM_NEAR, len(self._ranges)))
        return np.vstack([np.clip(present, 0, 1), anywhere, np.clip(near, 0, 1)])

    def values(self, units: Floats) -> dict[str, Any]:
        """Return the values of a candidate."""
        return {name: _value(domain, unit) for (name, domain), unit in zip(self._ranges.items(), units, strict=True)}


def _unit(domain: Range, value: Any) -> float:
    low, high = domain.codes
    code = domain.code_of(value)
    if domain.has_log_codes:
        low, high, code = math.log(low), math.log(high), math.log(code)
    return (code - low) / (high - low) if high > low else 0.5


def _value(domain: Range, unit: float) -> Any:
    low, high = domain.codes
    if domain.has_log_codes:
        code = math.exp(math.log(low) + unit * (math.log(high) - math.log(low)))
    else:
        code = low + unit * (high - low)
    return domain.of_code(min(max(code, low), high))


@dataclass(frozen=True)
class _Model:
    """A Gaussian process of standardised gains; its kernel is squared-exponential, and forgets with time."""

    times: Floats
    rows: Floats
    length: float
    forgetting: float
    noise: float
    weights: Floats

    @classmethod
    def fitted(cls, times: Floats, rows: Floats, gains: Floats) -> _Model:
        """Return the model whose settings make the gains likeliest."""
        middle = np.median(gains)
        if (greatest := gains.max() - middle) > 0:
            gains = np.maximum(gains, middle - _MOST_LOSS * greatest)
        spread = gains.std()
        targets = np.clip((gains - gains.mean()) / (spread if spread > 0 else 1.0), -_MOST, _MOST)
        best: tuple[float, float, float, float] | None = None
        for length in _LENGTH_SCALES:
            similar = _similarity(rows, rows, length)
            for forgetting in _FORGETTING:
                kernel = similar * _memory(times, times, forgetting)
                for noise in _NOISES:
                    likelihood = _log_likelihood(kernel, noise, targets)
                    if best is None or likelihood > best[0]:
                        best = likelihood, length, forgetting, noise
        assert best is not None
        _, length, forgetting, noise = best
        kernel = _similarity(rows, rows, length) * _memory(times, times, forgetting) + noise * np.eye(len(rows))
        return cls(times, rows, length, forgetting, noise, np.linalg.solve(kernel, targets))

    def upper_bounds(self, time: float, rows: Floats, meanwhile: Floats) -> Floats:
        """Return the upper confidence bound of what each row would gain, beside others that are trained then."""
        now = np.full(len(rows), time)
        mean = self._kernel(now, rows, self.times, self.rows) @ self.weights
        times = np.concatenate([self.times, np.full(len(meanwhile), time)])
        known = np.vstack([self.rows, meanwhile])
        across = self._kernel(now, rows, times, known)
        within = self._kernel(times, known, times, known) + self.noise * np.eye(len(known))
        explained = np.einsum("ij,ji->i", across, np.linalg.solve(within, across.T))
        beta = _FIRST_BETA + max(0.0, math.log(_BETA_RATE * len(self.rows)))
        upper: Floats = mean + math.sqrt(beta) * np.sqrt(np.maximum(1.0 - explained, 0.0))
        return upper

    def _kernel(self, first_times: Floats, first: Floats, second_times: Floats, second: Floats) -> Floats:
        return _similarity(first, second, self.length) * _memory(first_times, second_times, self.forgetting)


def _log_likelihood(kernel: Floats, noise: float, targets: Floats) -> float:
    """Return the logarithm of how likely the targets are, but for a constant.

    One Cholesky decomposition gives all of it, with the targets as one more row and column. NumPy's other ones take a
    hundred times as long at these sizes where their threads have to share the cores with trials.
    """
    num = len(targets)
    bordered = np.empty((num + 1, num + 1))
    bordered[:num, :num] = kernel + noise * np.eye(num)
    bordered[num, :num] = bordered[:num, num] = targets
    # More than the quadratic form can be, as no eigenvalue is below the noise.
    most = float(targets @ targets) / noise + 1.0
    bordered[num, num] = most
    roots = np.diagonal(np.linalg.cholesky(bordered))
    return -0.5 * (most - float(roots[num]) ** 2) - float(np.log(roots[:num]).sum())


def _similarity(first: Floats, second: Floats, length: float) -> Floats:
    squares = ((first[:, None, :] - second[None, :, :]) ** 2).sum(axis=-1)
    found: Floats = np.exp(-0.5 * squares / length**2)
    return found


def _memory(first: Floats, second: Floats, forgetting: float) -> Floats:
    """Return the time's part of the kernel (Bogunovic et al. 2016, "Time-Varying Gaussian Process Bandits")."""
    found: Floats = (1.0 - forgetting) ** (0.5 * np.abs(first[:, None] - second[None, :]))
    return found

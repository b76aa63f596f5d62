"""How far trainings went, as one more column of what a model sees: those that a scheduler ended were judged earlier.

Returns of half a training are of another level than those of a whole one, and say more of these on some tasks than on
others. A model that is told the length beside the point learns both, and is asked what whole trainings come to
(Kandasamy et al. 2017, "Multi-fidelity Bayesian Optimisation with Continuous Approximations"; Wistuba et al. 2022,
"Supervising the Multi-Fidelity Race of Hyperparameter Configurations", has a kernel over points and lengths, too).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tune_jobs.search.coordinates import Cube
from tune_jobs.search.history import KnownPoint

Floats = NDArray[np.float64]
_FACTOR = 20.0
"""Trainings whose lengths differ by this factor are as far apart as the ends of a range of the space."""
_SHORTEST = 1e-6


@dataclass(frozen=True)
class Lengths:
    """The column of a model for how long trainings were: 0 for whole ones, less for others. Not all models have one.

    Args:
        is_column: Whether it is there. Without a scheduler all trainings are whole. Where it is not known what any
            point had come to at a rung that it passed, kinds of points that all ended there could not be told from
            short trainings.
    """

    is_column: bool

    @classmethod
    def among(cls, known: Sequence[KnownPoint]) -> Lengths:
        """Return the column of a model of some points."""
        return cls(any(length_of(point) < 1.0 for point in known) and any(point.passed for point in known))

    def told(self, known: Sequence[KnownPoint]) -> list[KnownPoint]:
        """Return what a model with this column is told: before each point that ended what it had come to at rungs."""
        if not self.is_column:
            return list(known)
        told: list[KnownPoint] = []
        for point in known:
            told += [KnownPoint(point.point, (rung.score,), level=0, trained=rung.trained) for rung in point.passed]
            told.append(point)
        return told

    def beside(self, columns: Floats, known: Sequence[KnownPoint]) -> Floats:
        """Return the columns of points that have ended, with that of their trainings' lengths behind them.

        Args:
            columns: Shape (num_points, num_columns).
            known: The points, in the same order.
        """
        return self._with(columns, [math.log(length_of(point)) / math.log(_FACTOR) for point in known])

    def of_whole(self, columns: Floats) -> Floats:
        """Return the columns of points as those of whole trainings."""
        return self._with(columns, [0.0] * len(columns))

    def _with(self, columns: Floats, lengths: Sequence[float]) -> Floats:
        return np.column_stack([columns, lengths]) if self.is_column else columns

    def groups(self, cube: Cube) -> NDArray[np.int64]:
        """Return which columns have one length scale, from 0: those of the cube, and this."""
        groups = cube.group_of_column
        return np.append(groups, groups.max() + 1) if self.is_column else groups

    def places(self, units: Floats) -> Floats:
        """Return places in the cube, shape (any, num_sides), each once where one may be there for several lengths."""
        return np.unique(units, axis=0) if self.is_column else units


NO_COLUMN = Lengths(is_column=False)


def length_of(point: KnownPoint) -> float:
    """Return the share of its training after which a point's score was reached: below 1 if a scheduler ended it.

    What failed would not have come further.
    """
    if point.level is None or point.score is None:
        return 1.0
    return max(point.trained if point.length is None else point.length, _SHORTEST)

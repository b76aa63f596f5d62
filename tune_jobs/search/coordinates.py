"""Values of the search space as numbers that a model computes with, and back.

Optuna's samplers have its distributions. Models of our own see a point in the unit cube, one side for each name: on a
log scale where the domain is on one, and with steps where it has some. `Cube.columns` is what a model computes with: a
number between 0 and 1 for a range and for a list of numbers, whose middle is as far from the one end as from the other,
and for any other list a column for each of its values.

`tune_jobs.search.study` has other numbers for the same values: there people read them, so that they are the values
themselves; here lists and multiples of a step are counted, which is what a model can go by.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analysis.wording import is_number
from tune_jobs.spec.domains import Domain, Listed, Range

if TYPE_CHECKING:
    import optuna

Floats = NDArray[np.float64]


def distribution_of(domain: Any) -> optuna.distributions.BaseDistribution:
    """Return a domain in Optuna's form: lists and multiples of q by index, as Optuna has no log scale with steps."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if isinstance(domain, Listed):
        return CategoricalDistribution(tuple(range(len(domain.values))))
    assert isinstance(domain, Range)
    low, high = domain.codes
    if domain.is_stepped:
        return IntDistribution(int(low), int(high), log=domain.has_log_codes)
    return FloatDistribution(low, high, log=domain.has_log_codes)


def from_optuna(domain: Any, value: Any) -> Any:
    """Return the value of a domain that a parameter of Optuna's stands for."""
    if isinstance(domain, Listed):
        return domain.values[value]
    assert isinstance(domain, Range)
    return domain.of_code(value)


def to_optuna(domain: Any, value: Any) -> Any:
    """Return the parameter of Optuna's that stands for a value of a domain."""
    if isinstance(domain, Listed):
        return domain.index_of(value)
    assert isinstance(domain, Range)
    return domain.code_of(value)


class _ListSide:
    """A list: equal parts of the side, in the order of the numbers if it has nothing else."""

    def __init__(self, domain: Listed) -> None:
        self._values = domain.values
        self._is_ordered = all(map(is_number, domain.values))
        if self._is_ordered:
            self._values = tuple(sorted(domain.values))
        self._parts = {json.dumps(value): index for index, value in enumerate(self._values)}
        # One value is as far from another as the ends of a range are from each other.
        num_values = len(self._values)
        in_a_row = np.linspace(0.0, 1.0, num_values)[:, None]
        self._rows = in_a_row if self._is_ordered or num_values <= 2 else np.eye(num_values) * math.sqrt(0.5)

    @property
    def width(self) -> int:
        return int(self._rows.shape[1])

    @property
    def num_unordered(self) -> int:
        """How many values there are of which none is between two others; 0: they have an order."""
        return 0 if self._is_ordered else len(self._values)

    def _part(self, units: Floats) -> NDArray[np.int64]:
        return np.minimum((units * len(self._values)).astype(np.int64), len(self._values) - 1)

    def value(self, unit: float) -> Any:
        return self._values[int(self._part(np.asarray(unit)))]

    def unit(self, value: Any) -> float:
        return (self._parts[json.dumps(value)] + 0.5) / len(self._values)

    def columns(self, units: Floats) -> Floats:
        found: Floats = self._rows[self._part(units)]
        return found


class _RangeSide:
    """A range of real numbers."""

    width = 1
    num_unordered = 0

    def __init__(self, domain: Range) -> None:
        self._domain, self._is_log, self._codes = domain, domain.has_log_codes, domain.codes
        self._first, self._last = map(math.log, domain.codes) if self._is_log else domain.codes

    def value(self, unit: float) -> Any:
        inner = self._first + (self._last - self._first) * float(unit)
        low, high = self._codes
        # Rounding may lead out of the range.
        return self._domain.of_code(min(max(math.exp(inner) if self._is_log else inner, low), high))

    def unit(self, value: Any) -> float:
        code = self._domain.code_of(value)
        inner = math.log(code) if self._is_log else code
        return min(max((inner - self._first) / (self._last - self._first), 0.0), 1.0)

    def columns(self, units: Floats) -> Floats:
        return units[:, None]


class _StepSide:
    """A range with steps: whole numbers, or multiples of q. A step is as wide as it is likely to be drawn."""

    width = 1
    num_unordered = 0

    def __init__(self, domain: Range) -> None:
        self._domain, self._is_log = domain, domain.has_log_codes
        self._first, self._last = domain.codes
        ends = self._first, self._last + 1.0
        self._begin, self._end = map(math.log, ends) if self._is_log else ends

    def _steps(self, units: Floats) -> Floats:
        inner = self._begin + (self._end - self._begin) * units
        # The edge of a step belongs to it, whatever the rounding of logarithms.
        found = np.floor((np.exp(inner) if self._is_log else inner) + 1e-9)
        return np.clip(found, self._first, self._last)

    def value(self, unit: float) -> Any:
        return self._domain.of_code(int(self._steps(np.asarray(unit))))

    def unit(self, value: Any) -> float:
        code = self._domain.code_of(value) + 0.5
        inner = math.log(code) if self._is_log else code
        return min(max((inner - self._begin) / (self._end - self._begin), 0.0), 1.0)

    def columns(self, units: Floats) -> Floats:
        if self._first == self._last:
            return np.zeros((len(units), 1))
        found, first, last = self._steps(units), self._first, self._last
        if self._is_log:
            found, first, last = np.log(found), math.log(first), math.log(last)
        return ((found - first) / (last - first))[:, None]


def _side(domain: Domain) -> _ListSide | _RangeSide | _StepSide:
    if isinstance(domain, Listed):
        return _ListSide(domain)
    assert isinstance(domain, Range)
    return _StepSide(domain) if domain.is_stepped else _RangeSide(domain)


class Cube:
    """A search space as a unit cube.

    Args:
        space: Domains by name; their order is that of the cube's sides.
    """

    def __init__(self, space: Mapping[str, Domain]) -> None:
        self._sides = {name: _side(domain) for name, domain in space.items()}
        self.group_of_column = np.repeat(np.arange(len(self._sides)), [side.width for side in self._sides.values()])
        """The side that each column is of."""
        self.num_unordered = np.array([side.num_unordered for side in self._sides.values()])
        """How many values each side has that are in no order; 0: a range, or a list of numbers."""

    @property
    def num_sides(self) -> int:
        """How many names are searched."""
        return len(self._sides)

    def units(self, points: Sequence[Mapping[str, Any]]) -> Floats:
        """Return points in the cube, shape (num_points, num_sides). A name that a point lacks is in the middle."""
        rows = [
            [side.unit(point[name]) if name in point else 0.5 for name, side in self._sides.items()] for point in points
        ]
        return np.array(rows, dtype=np.float64).reshape(len(points), self.num_sides)

    def columns(self, units: Floats) -> Floats:
        """Return what a model computes with, shape (num_points, num_columns), of places in the cube."""
        return np.concatenate(
            [side.columns(units[:, index]) for index, side in enumerate(self._sides.values())], axis=1
        )

    def point(self, units: Floats) -> dict[str, Any]:
        """Return the point at a place in the cube, shape (num_sides,)."""
        return {name: side.value(unit) for (name, side), unit in zip(self._sides.items(), units, strict=True)}

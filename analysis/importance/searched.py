"""The searched hyperparameters of a sweep, from its record: which values each may take, and on which scale."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.wording import is_number

Floats = NDArray[np.float64]
MAX_LISTED_NUMBERS = 6
"""A list of more numbers than these is judged as a range: one effect for each would take too many points."""
NOT_SET = "not set"
"""The text for the value of a point that has none."""


@dataclass(frozen=True)
class Searched:
    """One searched hyperparameter, and the value that each point has."""

    name: str
    kind: str
    """The kind of its domain, such as loguniform or choice; empty if the record does not say."""
    arguments: tuple[Any, ...]
    """The arguments of the domain: its ends, or its values."""
    values: tuple[Any, ...]
    """One a point; None where a point has none."""

    @property
    def is_log(self) -> bool:
        """Whether equal ratios count as equal steps."""
        if "log" in self.kind:
            return True
        # Of listed numbers, as 1e-4, 1e-3, 1e-2, nobody says on which scale they are.
        numbers = [value for value in self.values if is_number(value)]
        return (
            self.kind in ("grid", "choice") and bool(numbers) and min(numbers) > 0 and max(numbers) > 10 * min(numbers)
        )

    @property
    def is_numeric(self) -> bool:
        """Whether it is judged as a number, not as a list of values; some points may have none."""
        numbers = [value for value in self.values if value is not None]
        if not numbers or not all(is_number(value) and math.isfinite(value) for value in numbers):
            return False
        return not self.is_listed or len(set(numbers)) > MAX_LISTED_NUMBERS

    @property
    def is_missing(self) -> NDArray[np.bool_]:
        """Which points have no value."""
        return np.array([value is None for value in self.values], dtype=np.bool_)

    @cached_property
    def keys(self) -> tuple[str, ...]:
        """The value of each point as text, equal where values are equal."""
        return tuple(_key(value) for value in self.values)

    @property
    def listed(self) -> tuple[Any, ...]:
        """The values that points have, each once: in the order of the sweep file, else as they come."""
        tried = {_key(value): value for value in self.values}
        order = [_key(value) for value in self.arguments if self.kind in ("grid", "choice")]
        return tuple(tried[key] for key in dict.fromkeys([*order, *tried]) if key in tried)

    @property
    def is_constant(self) -> bool:
        """Whether all points have the same value."""
        return len(set(self.keys)) < 2

    def scaled(self, values: Sequence[Any] | None = None) -> Floats:
        """Return numbers on the scale that they were searched on; NaN for none."""
        array = np.array(self.values if values is None else values, dtype=np.float64)
        return np.log(array) if self.is_on_log_scale else array

    def unscaled(self, value: float) -> float:
        """Return a number from the scale that it was searched on."""
        number = math.exp(value) if self.is_on_log_scale else float(value)
        return round(number) if self.is_whole else number

    @property
    def ends(self) -> tuple[float, float]:
        """The ends of the range; of listed numbers the least and the greatest."""
        given = [value for value in self.values if value is not None]
        numbers = given
        if not self.is_listed:
            low, high = self.arguments[:2]
            numbers = [low, high - self.upper_gap, *given]
        return float(min(numbers)), float(max(numbers))

    @property
    def upper_gap(self) -> int:
        """How far the greatest value is below the upper argument of the domain; as in `tune_jobs.spec.domains`."""
        return 1 if self.kind in ("randint", "lograndint") else 0

    @property
    def scaled_ends(self) -> tuple[float, float]:
        """The same on the scale that it was searched on."""
        low, high = self.scaled(self.ends)
        return float(low), float(high)

    @property
    def is_listed(self) -> bool:
        """Whether its domain lists its values."""
        return self.kind in ("grid", "choice", "")

    @property
    def is_whole(self) -> bool:
        """Whether all values are whole numbers."""
        return all(isinstance(value, int) for value in self.values if value is not None)

    @property
    def is_on_log_scale(self) -> bool:
        """Whether its scale is logarithmic, for which all its values must be greater than zero."""
        return self.is_log and min(self.ends) > 0


def searched(space: Any, points: Sequence[Mapping[str, Any]]) -> list[Searched]:
    """Return the searched hyperparameters, in the order of the sweep file.

    Args:
        space: The space of the resolved sweep file; what can't be understood in it is taken from the points.
        points: The values of each point.
    """
    domains = space if isinstance(space, Mapping) else {}
    names = dict.fromkeys([*domains, *(name for point in points for name in point)])
    return [_searched(str(name), domains.get(name), [point.get(name) for point in points]) for name in names]


def _searched(name: str, domain: Any, values: Sequence[Any]) -> Searched:
    kind, arguments = "", ()
    if isinstance(domain, Mapping) and len(domain) == 1:
        ((found, given),) = domain.items()
        listed = found in ("grid", "choice")
        is_range = isinstance(given, list | tuple) and len(given) > 1 and all(is_number(end) for end in given[:2])
        if isinstance(given, list | tuple) and (listed or is_range):
            kind, arguments = str(found), tuple(given)
    return Searched(name, kind, arguments, tuple(values))


def _key(value: Any) -> str:
    return NOT_SET if value is None else json.dumps(value, default=str)

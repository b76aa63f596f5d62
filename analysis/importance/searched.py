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

from analysis.domains import LISTED_KINDS, NEAR_ONE, arguments_of, conditions_of, is_log_kind, kind_of
from analysis.points import searched_names
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
    acts: tuple[bool, ...] | None = None
    """In which points it acts; None: in all. Elsewhere it has no value, and no part in what is said of it."""

    @property
    def is_log(self) -> bool:
        """Whether equal ratios count as equal steps."""
        if is_log_kind(self.kind):
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
    def is_idle(self) -> NDArray[np.bool_]:
        """In which points it does not act."""
        if self.acts is None:
            return np.zeros(len(self.values), dtype=np.bool_)
        return ~np.array(self.acts, dtype=np.bool_)

    @property
    def is_missing(self) -> NDArray[np.bool_]:
        """Which points have no value, among them those in which it does not act."""
        return np.array([value is None for value in self.values], dtype=np.bool_)

    @cached_property
    def keys(self) -> tuple[str, ...]:
        """The value of each point as text, equal where values are equal."""
        return tuple(_key(value) for value in self.values)

    @property
    def listed(self) -> tuple[Any, ...]:
        """The values that points have, each once: in the order of the sweep file, else as they come."""
        tried = {_key(value): value for value in self.acting_values}
        order = [_key(value) for value in self.arguments if self.kind in ("grid", "choice")]
        found = tuple(tried[key] for key in dict.fromkeys([*order, *tried]) if key in tried)
        return tuple(sorted(found)) if self.kind == "power_of_two" and all(map(is_number, found)) else found

    @property
    def is_constant(self) -> bool:
        """Whether all points in which it acts have the same value."""
        return len(set(map(_key, self.acting_values))) < 2

    @property
    def acting_values(self) -> tuple[Any, ...]:
        """The values of the points in which it acts."""
        if self.acts is None:
            return self.values
        return tuple(value for value, acts in zip(self.values, self.acts, strict=True) if acts)

    def scaled(self, values: Sequence[Any] | None = None) -> Floats:
        """Return numbers on the scale that they were searched on; NaN for none."""
        array = np.array(self.values if values is None else values, dtype=np.float64)
        if self.is_near_one:
            return -np.log(1.0 - array)
        return np.log(array) if self.is_on_log_scale else array

    def unscaled(self, value: float) -> float:
        """Return a number from the scale that it was searched on."""
        if self.is_near_one:
            return 1.0 - math.exp(-value)
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
    def is_near_one(self) -> bool:
        """Whether 1 - value is on a log scale, for which all its values must be below 1."""
        return self.kind == NEAR_ONE and max(self.ends) < 1

    @property
    def is_on_log_scale(self) -> bool:
        """Whether its scale is logarithmic, for which all its values must be greater than zero."""
        return self.is_log and min(self.ends) > 0


def searched(space: Any, points: Sequence[Mapping[str, Any]]) -> list[Searched]:
    """Return the searched hyperparameters, in the order of the sweep file.

    Layers that are searched one by one are their number and the size of each, `hidden_sizes.number`, `hidden_sizes.1`
    and so on; a layer that a network lacks does not act.

    Args:
        space: The space of the resolved sweep file; what can't be understood in it is taken from the points.
        points: The values of each point.
    """
    domains = space if isinstance(space, Mapping) else {}
    names = dict.fromkeys([*domains, *searched_names(points)])
    found = []
    for name in names:
        domain = domains.get(name)
        found += _layers(name, domain, points) or [_searched(str(name), domain, points)]
    return found


def _layers(name: str, domain: Any, points: Sequence[Mapping[str, Any]]) -> list[Searched]:
    given = arguments_of(domain) if kind_of(domain) == "layers" else None
    lists = [point[name] for point in points if name in point]
    if not isinstance(given, Mapping) or not lists or not all(isinstance(sizes, list | tuple) for sizes in lists):
        return []
    parts: list[dict[str, Any]] = []
    for point in points:
        sizes = point.get(name, ())
        number = {f"{name}.number": len(sizes)} if sizes else {}
        parts.append(number | {f"{name}.{index}": size for index, size in enumerate(sizes, start=1)})
    numbers = {"choice": sorted({len(sizes) for sizes in lists})}
    domains = {part: given.get("sizes") for part in searched_names(parts)} | {f"{name}.number": numbers}
    return [_searched(part, domains[part], parts, is_conditional=True) for part in searched_names(parts)]


def _searched(name: str, domain: Any, points: Sequence[Mapping[str, Any]], *, is_conditional: bool = False) -> Searched:
    kind, arguments = "", ()
    given = arguments_of(domain)
    is_range = isinstance(given, list | tuple) and len(given) > 1 and all(is_number(end) for end in given[:2])
    if isinstance(given, list | tuple) and (kind_of(domain) in LISTED_KINDS or is_range):
        kind, arguments = kind_of(domain), tuple(given)
    # Without a condition nobody knows why a point lacks a value: that may make a difference by itself.
    acts = tuple(name in point for point in points) if is_conditional or conditions_of(domain) else ()
    return Searched(name, kind, arguments, tuple(point.get(name) for point in points), None if all(acts) else acts)


def _key(value: Any) -> str:
    return NOT_SET if value is None else json.dumps(value, default=str)

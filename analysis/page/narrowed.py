"""A narrower search space, around the settings that did best."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from analysis.domains import CONDITION, LISTED_KINDS, NEAR_ONE, arguments_of, conditions_of, is_log_kind, kind_of
from analysis.points import in_one_form
from analysis.wording import is_number

_MARGIN = 0.25
"""How far the new range goes beyond the values that did well, as a share of their own range."""


def narrowed_space(space: Mapping[str, Any], points: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a search space narrowed to where some points lie; what can't be narrowed stays as it is.

    Listed values are kept if a point has them; ranges go from the least to the greatest value of the points and a
    quarter of that further, but nowhere beyond their ends, and not below half of the least if that is positive. On a
    log scale that is done with logarithms.

    Args:
        space: The domains as a sweep file has them, by name: `{"lr": {"loguniform": [1e-5, 1e-2]}}`.
        points: The points that did well.
    """
    narrowed = {
        name: _narrowed(domain, [point[name] for point in points if name in point]) for name, domain in space.items()
    }
    # As the space itself reads them: [32, 64] is one value if it lists that, which the narrowed one may not.
    named = {
        name: {other: _listed(given, space.get(other)) for other, given in conditions_of(domain).items()}
        for name, domain in space.items()
    }
    return _with_possible_conditions(narrowed, named)


def _narrowed(domain: Any, values: Sequence[Any]) -> Any:
    kind, ends = kind_of(domain), arguments_of(domain)
    if not kind or not values or not isinstance(ends, list | tuple):
        return domain
    if kind in LISTED_KINDS:
        known = set(map(_meaning, values))
        kept = [value for value in ends if _meaning(value) in known]
        return {**domain, kind: kept or ends}
    if len(ends) < 2 or not all(is_number(value) and math.isfinite(value) for value in (*ends, *values)):
        return domain
    return {**domain, kind: _range(kind, ends, values)}


def _with_possible_conditions(
    space: Mapping[str, Any], named: Mapping[str, Mapping[str, Sequence[Any]]]
) -> dict[str, Any]:
    """Return a space without conditions on values that it does not have any more, and without what could never act.

    Args:
        space: The domains.
        named: The values that the conditions of each name, by the names that these are on.
    """
    found: dict[str, Any] = {}
    for name, domain in space.items():
        conditions = {
            other: [value for value in values if _has(space.get(other), value)] for other, values in named[name].items()
        }
        if all(conditions.values()):
            kept = {other: values[0] if len(values) == 1 else values for other, values in conditions.items()}
            found[name] = {**domain, CONDITION: kept} if conditions else domain
    # What depended on something that is gone is gone too.
    return found if len(found) == len(space) else _with_possible_conditions(found, named)


def _listed(given: Any, domain: Any) -> list[Any]:
    return list(given) if isinstance(given, list | tuple) and not _has(domain, given) else [given]


def _has(domain: Any, value: Any) -> bool:
    """Whether a domain has a value, as far as a condition needs to know."""
    kind, ends = kind_of(domain), arguments_of(domain)
    if kind in LISTED_KINDS and isinstance(ends, list | tuple):
        return _meaning(value) in map(_meaning, ends)
    if not is_number(value) or not isinstance(ends, list | tuple) or len(ends) < 2 or not all(map(is_number, ends)):
        return False
    return bool(ends[0] <= value and (value < ends[1] if kind in ("randint", "lograndint") else value <= ends[1]))


def _meaning(value: Any) -> str:
    """Return a text that is equal for values that mean the same: lists can't be in a set."""
    return json.dumps(in_one_form(value), default=str)


def _range(kind: str, ends: Sequence[float], values: Sequence[float]) -> list[float]:
    low, high, *step = ends
    if kind == "power_of_two":
        least, most = max(low, min(values) // 2), min(high, max(values) * 2)
        return [int(least), int(most)] if 0 < least < most else list(ends)
    if kind == NEAR_ONE and max(*ends, *values) < 1:
        distances = _range("loguniform", [1 - high, 1 - low], [1 - value for value in values])
        least, most = (round(1 - distance, 15) for distance in reversed(distances))
        return [max(low, least), min(high, most)]
    log = is_log_kind(kind) and low > 0 and min(values) > 0
    first, last = (math.log(min(values)), math.log(max(values))) if log else (min(values), max(values))
    margin = _MARGIN * (last - first) if last > first else _MARGIN * (math.log(high / low) if log else high - low) / 2
    least, most = (math.exp(first - margin), math.exp(last + margin)) if log else (first - margin, last + margin)
    if min(values) > 0:
        # Half of the least value that did well is far enough, however wide the range is.
        least = max(least, min(values) / 2)
    if "int" in kind:
        # The upper end of whole ranges without a step is left out.
        least, most = math.floor(least), math.ceil(most) + (0 if step else 1)
    elif not step:
        least, most = _rounded(least, most, values)
    if step:
        least, most = math.floor(least / step[0]) * step[0], math.ceil(most / step[0]) * step[0]
        if "int" not in kind:
            # 7 * 0.1 is 0.7000000000000001.
            least, most = float(f"{least:.12g}"), float(f"{most:.12g}")
    least, most = max(low, least), min(high, most)
    return [least, most, *step] if least < most else list(ends)


def _rounded(least: float, most: float, values: Sequence[float]) -> tuple[float, float]:
    """Return the ends of a range in as few digits as leave no value out, three at least."""
    for digits in range(3, 17):
        low, high = (float(f"{end:.{digits}g}") for end in (least, most))
        if low <= min(values) and max(values) <= high:
            return low, high
    return min(least, *values), max(most, *values)

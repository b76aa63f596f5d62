"""A narrower search space, around the settings that did best."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from analysis.wording import is_number

_MARGIN = 0.25
"""How far the new range goes beyond the values that did well, as a share of their own range."""
_LISTED = ("grid", "choice")


def narrowed_space(space: Mapping[str, Any], points: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a search space narrowed to where some points lie; what can't be narrowed stays as it is.

    Listed values are kept if a point has them; ranges go from the least to the greatest value of the points and a
    quarter of that further, but nowhere beyond their ends, and not below half of the least if that is positive. On a
    log scale that is done with logarithms.

    Args:
        space: The domains as a sweep file has them, by name: `{"lr": {"loguniform": [1e-5, 1e-2]}}`.
        points: The points that did well.
    """
    return {
        name: _narrowed(domain, [point[name] for point in points if name in point]) for name, domain in space.items()
    }


def _narrowed(domain: Any, values: Sequence[Any]) -> Any:
    if not isinstance(domain, Mapping) or len(domain) != 1 or not values:
        return domain
    kind, ends = next(iter(domain.items()))
    if not isinstance(ends, list | tuple):
        return domain
    if kind in _LISTED:
        # As text, as lists can't be in a set, and a tuple is the same value as a list.
        known = {json.dumps(value) for value in values}
        kept = [value for value in ends if json.dumps(value) in known]
        return {kind: kept} if kept else domain
    if len(ends) < 2 or not all(is_number(value) and math.isfinite(value) for value in (*ends, *values)):
        return domain
    return {kind: _range(kind, ends, values)}


def _range(kind: str, ends: Sequence[float], values: Sequence[float]) -> list[float]:
    low, high, *step = ends
    log = "log" in kind and low > 0 and min(values) > 0
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
        least, most = _rounded(least), _rounded(most)
    if step:
        least, most = math.floor(least / step[0]) * step[0], math.ceil(most / step[0]) * step[0]
    least, most = max(low, least), min(high, most)
    return [least, most, *step] if least < most else list(ends)


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")

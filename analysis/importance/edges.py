"""Ends of a hyperparameter's values at which the best points lie: beyond them may be better values."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import ValidationError

from analysis.domains import is_log_kind
from analysis.importance.answer import Edge
from analysis.importance.model import Fit, Floats, Terms
from analysis.importance.searched import Searched
from analysis.wording import is_number, short_text
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM, make_hyperparams

_END, _OUTER, _BAND = 0.1, 0.2, 0.15
"""Parts of a range: in which the model's best value must be, in which most of the best points must be, and which of the
two outermost must be the better one."""
_LEAST_TOP = 3
_TOP_SHARE = 0.1
_FURTHER = 1.0 / 3.0
"""How much further a range is taken, as a part of itself on its scale; on a log scale at most tenfold."""


def find_edges(
    hyperparams: Sequence[Searched], terms: Terms, fitted: Fit, outcome: Floats, spec: Mapping[str, Any]
) -> list[Edge]:
    """Return the ends that are worth moving.

    The model's best value of a number must be at an end, and at least half of the best tenth of the points, three at
    least; the points at the very end must be better than those beside them; and the algorithm must take a value beyond
    it. Decision 30 says how often that is so where the best value lies within.

    Args:
        hyperparams: The ones that clearly matter.
        terms: The model.
        fitted: Its fit.
        outcome: The rank of each point.
        spec: The sweep's spec.
    """
    found = []
    num_top = max(_LEAST_TOP, math.ceil(_TOP_SHARE * len(outcome)))
    top = np.argsort(-outcome, kind="stable")[:num_top]
    for item in hyperparams:
        if not all(is_number(value) and math.isfinite(value) for value in item.values):
            continue
        own = terms.owners == terms.names.index(item.name)
        curve = terms.columns[:, own] @ fitted.coefficients[0, own]
        rest = outcome - terms.columns[:, ~own] @ fitted.coefficients[0, ~own]
        place = _places(item)
        for side, distance in (("low", place), ("high", 1.0 - place)):
            is_at_end = distance[int(np.argmax(curve))] < _END
            has_most = 2 * int((distance[top] < _OUTER).sum()) >= num_top
            if is_at_end and has_most and _rises(item, distance, rest):
                edge = _edge(item, side, spec, item_point(hyperparams, int(top[0])))
                if edge is not None:
                    found.append(edge)
    return found


def _rises(item: Searched, distance: Floats, rest: Floats) -> bool:
    """Whether points at the very end are better than those beside them; of a list the last value than the one before.

    Args:
        item: The hyperparameter.
        distance: How far from the end each point is.
        rest: What the other hyperparameters leave of the outcome.
    """
    is_fine = item.is_numeric and item.kind != "power_of_two"
    first, second = (_BAND, 2.0 * _BAND) if is_fine else np.unique(distance)[:2] + 1e-9
    outer, inner = rest[distance <= first], rest[(distance > first) & (distance <= second)]
    return bool(outer.size and inner.size and outer.mean() > inner.mean())


def item_point(hyperparams: Sequence[Searched], index: int) -> dict[str, Any]:
    """Return the values of one point, of what acts in it."""
    return {item.name: item.values[index] for item in hyperparams if not item.is_idle[index]}


def _places(item: Searched) -> Floats:
    """Return where the values lie between the ends, 0 to 1; listed numbers at equal distances."""
    if not item.is_numeric:
        listed = sorted(set(item.values))
        return np.array([listed.index(value) for value in item.values]) / max(1, len(listed) - 1)
    low, high = item.scaled_ends
    places: Floats = np.clip((item.scaled() - low) / max(high - low, 1e-300), 0.0, 1.0)
    return places


def _edge(item: Searched, side: str, spec: Mapping[str, Any], point: Mapping[str, Any]) -> Edge | None:
    end = item.ends[0 if side == "low" else 1]
    if item.is_whole:
        end = int(end)
    further = next((value for value in _beyond(item, side) if _is_taken(item.name, value, spec, point)), None)
    if further is None:
        return None
    domain = {item.kind: _arguments(item, side, further)}
    text = (
        f"The best points have {item.name} at the {'lower' if side == 'low' else 'upper'} end of its values, "
        f"{short_text(end)}: better ones may lie beyond. Widen it to {item.name}: "
        f"{{{item.kind}: {json.dumps(domain[item.kind])}}}"
    )
    return Edge(item.name, side, end, domain, text)


def _arguments(item: Searched, side: str, further: float) -> list[Any]:
    if item.is_listed:
        return [further, *item.arguments] if side == "low" else [*item.arguments, further]
    low, high, *rest = item.arguments
    further = int(further) if item.is_whole else round(further, 15)
    return [further, high, *rest] if side == "low" else [low, further + item.upper_gap, *rest]


def _beyond(item: Searched, side: str) -> list[float]:
    """Return values beyond an end, the furthest first; some algorithms take none, or a limit such as 1."""
    low, high = item.scaled_ends
    step = (high - low) * _FURTHER
    if item.is_on_log_scale:
        step = min(step, math.log(10.0))
    if item.is_listed:
        listed = sorted(set(item.scaled()))
        step = float(listed[1] - listed[0] if side == "low" else listed[-1] - listed[-2])
    end = item.ends[0 if side == "low" else 1]
    if item.kind == "power_of_two":
        return [value for factor in (4, 2) if (value := end / factor if side == "low" else end * factor) >= 1]
    beyond = item.unscaled(low - step if side == "low" else high + step)
    beyond = 1.0 - _rounded(1.0 - beyond) if item.is_near_one else _rounded(beyond)
    if item.is_near_one and side == "high":
        return [beyond] if end < beyond < 1.0 else []
    values = [beyond, *(limit for limit in (0.0, 1.0) if min(beyond, end) < limit < max(beyond, end))]
    if item.is_whole:
        values = [round(value) for value in values]
    if is_log_kind(item.kind):
        values = [value for value in values if value > 0]
    return [value for value in values if (value < end if side == "low" else value > end)]


def _rounded(value: float) -> float:
    return float(f"{value:.2g}")


def _is_taken(name: str, value: float, spec: Mapping[str, Any], point: Mapping[str, Any]) -> bool:
    algorithm = spec.get("algorithm")
    if algorithm not in HYPERPARAMS_BY_ALGORITHM:
        return True
    fixed = spec.get("hyperparams")
    # A point may have what is no hyperparameter: the length of training, or a layer that is judged by itself.
    known = HYPERPARAMS_BY_ALGORITHM[algorithm].model_fields
    own = {key: given for key, given in point.items() if key in known}
    values = {**(fixed if isinstance(fixed, Mapping) else {}), **own, name: value}
    try:
        make_hyperparams(algorithm, values)
    except ValidationError:
        return False
    return True

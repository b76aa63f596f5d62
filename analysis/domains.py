"""Domains of a search space as a sweep's record has them: `{"loguniform": [1e-5, 1e-2], "when": {...}}`.

The record is not trusted to be right: what can't be understood has no kind.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

LISTED_KINDS = ("grid", "choice")
CONDITION = "when"


def kind_of(domain: Any) -> str:
    """Return the kind of a domain, such as "loguniform"; empty if it is none."""
    kinds = [key for key in domain if key != CONDITION] if isinstance(domain, Mapping) else []
    return str(kinds[0]) if len(kinds) == 1 else ""


def arguments_of(domain: Any) -> Any:
    """Return what stands behind the kind: a range's ends, or a list's values; None if it is no domain."""
    kind = kind_of(domain)
    return domain[kind] if kind else None


def conditions_of(domain: Any) -> Mapping[str, Any]:
    """Return what has to hold for a hyperparameter to act; empty: it always acts."""
    found = domain.get(CONDITION) if isinstance(domain, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def is_log_kind(kind: str) -> bool:
    """Whether equal ratios of values count as equal steps."""
    return ("log" in kind and kind != NEAR_ONE) or kind == "power_of_two"


NEAR_ONE = "one_minus_loguniform"
"""The kind of which 1 - value is on a log scale."""


def distance_to_one(value: float) -> float:
    """Return the place of a value on the scale of `NEAR_ONE`, which rises with the value."""
    return -math.log(1.0 - value)

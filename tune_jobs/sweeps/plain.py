"""Records and results as JSON-like data: what `--json` prints and what the service answers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

if TYPE_CHECKING:
    from analysis.records import TrialRecord

# Derived values, so that readers of the JSON need not compute them.
_DERIVED = ("num_episodes", "mean_return", "std_return", "solved", "optimism_gap")


def to_json(value: Any) -> Any:
    """Turn records, dataclasses and paths into JSON-like data; a number that isn't finite becomes null."""
    if isinstance(value, BaseModel):
        data = {name: getattr(value, name) for name in type(value).model_fields}
        data |= {name: getattr(value, name) for name in _DERIVED if hasattr(type(value), name)}
        return to_json(data)
    if is_dataclass(value) and not isinstance(value, type):
        named = {field.metadata.get("json", field.name): getattr(value, field.name) for field in fields(value)}
        # What has no name there is for this machine alone.
        named.pop(None, None)
        return to_json(named)
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    return [to_json(item) for item in value] if isinstance(value, Iterable) else str(value)


def score_point(record: TrialRecord) -> dict[str, Any] | None:
    """Return the searched values that a trial's score was reached with; None: they are its newest, as nearly always."""
    from analysis.tables import shown_point

    point = shown_point(record)
    return None if point == record.point else to_json(point)

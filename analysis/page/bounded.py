"""Returns near the largest floats, which an env may give, made small enough to be added and drawn."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from analysis.compact import CompactIterations
from analysis.plot_style import MAX_DRAWN
from analysis.records import IterationRecord


def bounded(results: Mapping[str, Sequence[IterationRecord]]) -> Mapping[str, Sequence[IterationRecord]]:
    """Return iterations whose returns are at most 1e100 in size, so that their sums are finite, too."""
    if all(_is_bounded(item) for items in results.values() for item in items):
        return results
    return {trial_id: CompactIterations(map(_bounded, items)) for trial_id, items in results.items()}


def _is_bounded(item: IterationRecord) -> bool:
    returns = (item.training_return or 0.0, item.evaluation_return or 0.0)
    return all(abs(value) <= MAX_DRAWN for value in (*returns, *item.episode_returns) if not math.isnan(value))


def _bounded(item: IterationRecord) -> IterationRecord:
    if _is_bounded(item):
        return item
    return item.model_copy(
        update={
            "training_return": _limited(item.training_return),
            "evaluation_return": _limited(item.evaluation_return),
            "episode_returns": tuple(value if math.isnan(value) else _limited(value) for value in item.episode_returns),
        }
    )


def _limited(value: float | None) -> float | None:
    return None if value is None else max(-MAX_DRAWN, min(MAX_DRAWN, value))

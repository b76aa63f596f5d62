"""Points whose values are not all of the same names: a searched hyperparameter that doesn't act in one has no value."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from analysis.wording import PLAIN_NONE, is_number, setting_text, short_text


class Idle:
    """The place of a value that is none, as the hyperparameter does not act."""


IDLE = Idle()
EMPTY = ""
"""The text in tables for a hyperparameter that does not act in a point."""


def searched_names(points: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return the names of all points' values, in the order of the sweep file, as far as points tell it."""
    names: list[str] = []
    for point in points:
        place = 0
        for name in point:
            if name in names:
                place = max(place, names.index(name) + 1)
            else:
                names.insert(place, name)
                place += 1
    return names


def lacks(point: Mapping[str, Any], name: str) -> bool:
    """Whether a hyperparameter does not act in a point; of a point that is not chosen yet nothing is known."""
    return bool(point) and name not in point


def value_of(point: Mapping[str, Any], name: str) -> Any:
    """Return a value of a point; `IDLE` where it does not act, and None where it is not known yet."""
    return IDLE if lacks(point, name) else point.get(name)


def value_text(
    point: Mapping[str, Any], name: str, text: Callable[[Any], str] = setting_text, none: str = PLAIN_NONE
) -> str:
    """Return the text of a point's value; empty where it does not act.

    Args:
        point: The point; empty: it is not chosen yet.
        name: The hyperparameter.
        text: Returns the text of a value.
        none: The text of a value that is not known yet.
    """
    return text(point[name]) if name in point else EMPTY if lacks(point, name) else none


def meaning_of(point: Mapping[str, Any]) -> str:
    """Return a text that is equal for points of equal values, however these are written.

    As in sweep files, 2e3 is 2000 and [64] is 64, but true is not 1.
    """
    return json.dumps({name: in_one_form(value) for name, value in point.items()}, sort_keys=True, default=str)


def in_one_form(value: Any) -> Any:
    """Return a value as every other way to write it has it, too."""
    if isinstance(value, list | tuple):
        items = list(map(in_one_form, value))
        return items[0] if len(items) == 1 and is_number(items[0]) else items
    return int(value) if isinstance(value, float) and value.is_integer() else value


def setting_labels(points: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return short texts of points: their values; with their names where not all points have the same."""
    are_alike = len({tuple(point) for point in points}) < 2
    if are_alike:
        return [" · ".join(map(short_text, point.values())) for point in points]
    return [", ".join(f"{name} {short_text(value)}" for name, value in point.items()) for point in points]

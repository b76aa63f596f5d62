"""Explain in plain words what pydantic finds wrong with values, in place of pydantic's own messages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import ValidationError

from policies.errors import shortened
from policies.suggestions import did_you_mean

Detail = Mapping[str, Any]
"""One error that pydantic found, with the keys type, loc, input and ctx."""


# What is wanted, by the type of pydantic's error; names in braces come from the error's context.
_WANTED = {
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_parsing_size": "a smaller whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "string_type": "a text",
    "string_too_short": "a text that is not empty",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a mapping of names to values",
    "mapping_type": "a mapping of names to values",
    "model_type": "a mapping of its fields to values",
    "model_attributes_type": "a mapping of its fields to values",
    "greater_than": "greater than {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than": "less than {lt:g}",
    "less_than_equal": "at most {le:g}",
    "literal_error": "{expected}",
}


def details_of(error: ValidationError) -> list[Detail]:
    """Return the errors that pydantic found, each of them once."""
    details: list[Detail] = list(error.errors(include_url=False))
    places = [detail["loc"] for detail in details]
    # pydantic also calls a list too short if some of its values are wrong; only the wrong values are reported.
    return [
        detail
        for detail in details
        if detail["type"] != "too_short"
        or not any(place != detail["loc"] and place[: len(detail["loc"])] == detail["loc"] for place in places)
    ]


def explain(detail: Detail) -> str:
    """Return what is wrong with one value, and what it should be."""
    kind, value, context = detail["type"], detail["input"], detail.get("ctx", {})
    if kind == "value_error":
        return str(context["error"])
    if kind == "missing":
        return "is missing"
    if kind in ("too_short", "too_long"):
        return _of_wrong_length(kind, value, context)
    wanted = _WANTED.get(kind)
    text = f"{shortened(value)} is not allowed"
    if wanted is None:
        return text
    text += f": it should be {wanted.format(**context)}"
    if kind == "literal_error" and isinstance(value, str):
        # pydantic's context has the allowed words in quotes.
        text += "." + did_you_mean(value, context["expected"].split("'")[1::2])
    return text


def _of_wrong_length(kind: str, value: Any, context: Mapping[str, Any]) -> str:
    short = kind == "too_short"
    number = context["min_length"] if short else context["max_length"]
    items = "value" if number == 1 else "values"
    return f"{shortened(value)} is not allowed: it should have at {'least' if short else 'most'} {number} {items}"


def dotted(location: Iterable[int | str], *, root: bool = True) -> str:
    """Return a location in the sweep file as people write it: ('space', 'lr', 'grid', 0) is space.lr.grid[0]."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location)
    return text.removeprefix(".") if root else text

"""The hyperparameters of each algorithm as a table: defaults, ranges, meanings, and other libraries' names for them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args

from pydantic import BaseModel, ConfigDict

from policies.errors import SpecError
from policies.foreign_names import FOREIGN_NAMES, LIBRARIES, ForeignName, Library, names_for
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM, Algorithm
from policies.suggestions import did_you_mean
from tune_jobs.spec.file import json_schema

TYPE_WORDS = {
    "integer": "whole number",
    "number": "number",
    "string": "text",
    "boolean": "true or false",
    "null": "null",
    "object": "mapping",
}
"""What the types of JSON Schema are called."""


class ForeignRow(BaseModel):
    """Another library's name."""

    model_config = ConfigDict(frozen=True)

    library: Library
    name: str
    difference: str
    """Where its values mean something else; empty: they mean the same."""


class HyperparamRow(BaseModel):
    """One hyperparameter."""

    model_config = ConfigDict(frozen=True)

    name: str
    default: Any
    values: str
    """The types and the range that are accepted, in words."""
    meaning: str
    elsewhere: tuple[ForeignRow, ...]
    """What other libraries call it; empty: they have no such setting, or it is not known."""


class HyperparamTable(BaseModel):
    """The hyperparameters of one algorithm."""

    model_config = ConfigDict(frozen=True)

    algorithm: Algorithm
    hyperparams: tuple[HyperparamRow, ...]
    not_here: tuple[ForeignRow, ...]
    """Settings of other libraries that are no hyperparameters here, with what to do instead."""


def hyperparam_tables(algorithm: str | None = None) -> list[HyperparamTable]:
    """Return the tables of all algorithms, or of one.

    Raises:
        SpecError: There is no such algorithm; the message names the nearest.
    """
    known: tuple[Algorithm, ...] = get_args(Algorithm)
    wanted = [name for name in known if algorithm in (None, name)]
    if not wanted:
        raise SpecError(
            f"There is no algorithm {algorithm!r}.{did_you_mean(algorithm, known)}", f"There are {', '.join(known)}."
        )
    return [hyperparam_table(name) for name in wanted]


def hyperparam_table(algorithm: Algorithm) -> HyperparamTable:
    """Return the table of one algorithm, in the order of its model."""
    schema = json_schema()["$defs"][HYPERPARAMS_BY_ALGORITHM[algorithm].__name__]
    rows = [
        HyperparamRow(
            name=name,
            default=field["default"],
            values=" or ".join(dict.fromkeys(_values(field))),
            meaning=field["description"],
            elsewhere=tuple(map(_row, names_for(algorithm, name))),
        )
        for name, field in schema["properties"].items()
    ]
    lacking = [_row(foreign) for foreign in FOREIGN_NAMES[algorithm] if not foreign.ours]
    return HyperparamTable(algorithm=algorithm, hyperparams=tuple(rows), not_here=tuple(lacking))


def elsewhere_text(row: HyperparamRow) -> dict[str, str]:
    """Return the names of a hyperparameter by library, with what is different about them."""
    texts = {}
    for library, name in LIBRARIES.items():
        by_difference: dict[str, list[str]] = {}
        for foreign in row.elsewhere:
            if foreign.library == library:
                by_difference.setdefault(foreign.difference, []).append(foreign.name)
        named = [", ".join(names) + (f" ({why})" if why else "") for why, names in by_difference.items()]
        if named:
            texts[name] = "; ".join(named)
    return texts


def range_text(field: Mapping[str, Any]) -> str:
    """Return the range of a field of a JSON Schema in words; empty: it has none."""
    low, high = field.get("minimum"), field.get("maximum")
    if low is not None and high is not None and not field.keys() & {"exclusiveMinimum", "exclusiveMaximum"}:
        return f"from {low:,g} to {high:,g}"
    limits = [("exclusiveMinimum", "minimum", ">", "≥"), ("exclusiveMaximum", "maximum", "<", "≤")]
    found = []
    for exclusive, inclusive, strictly, at_most in limits:
        if exclusive in field:
            found.append(f"{strictly} {field[exclusive]:,g}")
        elif inclusive in field:
            found.append(f"{at_most} {field[inclusive]:,g}")
    return ", ".join(found)


def _row(foreign: ForeignName) -> ForeignRow:
    return ForeignRow(library=foreign.library, name=foreign.name, difference=foreign.difference)


def _values(field: Mapping[str, Any]) -> list[str]:
    """Return the types and ranges of a field, each in words."""
    if "anyOf" in field:
        return [words for kind in field["anyOf"] for words in _values(kind)]
    if "prefixItems" in field:
        return [f"[{', '.join(words for item in field['prefixItems'] for words in _values(item))}]"]
    if "items" in field:
        return [f"list of: {words}" for words in _values(field["items"])]
    if "enum" in field:
        return [", ".join(map(str, field["enum"]))]
    return [" ".join(filter(None, (TYPE_WORDS[field.get("type", "object")], range_text(field))))]

"""Lists that a sweep file leaves out or nests wrongly: say exactly what to write in their place.

`hidden_sizes: 64` is one layer, also in a grid. What has one meaning only is understood; what is wrong, or may mean two
things, is answered with what to write for each.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from analysis.records import TRAINING_LENGTH
from policies.errors import shortened
from tune_jobs.spec.domain_kinds import text_of
from tune_jobs.spec.domains import DOMAIN_KINDS

_NUMBERS = re.compile(r"[\[(]? ?\d{1,9}(?:(?:, ?| ?x ?| )\d{1,9})*,? ?[\])]?")
_MOST_SHOWN = 100
"""The most characters of a list that a message writes out."""
_TO_TRY = "to try each of its values"


def list_to_write(value: Any, is_allowed: Callable[[Any], bool]) -> list[Any] | None:
    """Return the list that was probably meant where a value is not allowed; None: it is not known.

    Args:
        value: What was given, such as "64x64" for [64, 64].
        is_allowed: Whether a list may stand in its place.
    """
    forms: list[Any] = []
    if isinstance(value, str):
        forms.append(_numbers_in(value))
    elif isinstance(value, int | float | list | tuple) and not isinstance(value, bool):
        forms.append([value])
        if isinstance(value, list | tuple) and len(value) == 1:
            forms.append(value[0])
    return next((form for form in forms if isinstance(form, list) and is_allowed(form)), None)


def text_of_several(name: str, value: Any, is_allowed: Callable[[Any], bool]) -> str | None:
    """Return how to search a hyperparameter that is fixed at several values, or at a domain; None: it is neither."""
    if isinstance(value, Mapping) and len(value) == 1 and next(iter(value)) in DOMAIN_KINDS:
        return f"{shortened(value)} is a domain, not one value: write it as space.{name}"
    if isinstance(value, list | tuple) and len(value) > 1 and all(map(is_allowed, value)):
        grid = f"{{grid: {_written(_once(value))}}}"
        return f"{shortened(value)} is a list of values: write {grid} as space.{name} {_TO_TRY}"
    return None


def text_of_no_domain(name: str, value: Any) -> str | None:
    """Return how to write a domain in the place of a list or of one value; None: it is neither."""
    if isinstance(value, list | tuple) and value:
        if len(value) == 1 and isinstance(value[0], Mapping) and set(value[0]) & set(DOMAIN_KINDS):
            return f"{shortened(value)} is a list of one domain: write {shortened(value[0])} alone, without the dash"
        if name == "hidden_sizes" and all(type(size) is int for size in value):
            network = f"{{grid: [{_written(value)}]}} for one network of {_layers(len(value))}"
            each = f"{{grid: {_written([[size] for size in value])}}} to try each as one layer, or "
            return f"{shortened(value)} is a bare list: write {'' if _repeats(value) else each}{network}"
        return f"{shortened(value)} is a bare list: write {{grid: {_written(_once(value))}}} {_TO_TRY}"
    if isinstance(value, int | float) and not isinstance(value, bool):
        where = f"as {name}" if name == TRAINING_LENGTH else "under hyperparams"
        return f"{value!r} is one value: fix it {where}, or write {{grid: [{value!r}]}}"
    return None


def text_of_no_list(name: str, value: Any) -> str | None:
    """Return how to write the list that a grid or a choice takes, where one value was given; None: it is not known."""
    text = f"{shortened(value)} is not allowed: it should be a list"
    if name == "hidden_sizes" and isinstance(value, str) and (sizes := _numbers_in(value)) is not None:
        if len(sizes) == 1:
            return f"{text}: write {sizes!r}"
        network = f"[{sizes!r}] for one network of {_layers(len(sizes))}"
        return f"{text}: write {'' if _repeats(sizes) else f'{sizes!r} to try each as one layer, or '}{network}"
    if isinstance(value, bool):
        return f"{text}: write [{str(value).lower()}]"
    return f"{text}: write [{value!r}]" if isinstance(value, int | float) else None


def _numbers_in(text: str) -> list[int] | None:
    """Return the whole numbers of a text such as "64, 64" or "64x64"; None: there is more in it, or nothing."""
    return [int(number) for number in re.findall(r"\d+", text)] if _NUMBERS.fullmatch(text.strip()) else None


def _once(values: Sequence[Any]) -> list[Any]:
    """Return values as a grid may list them, which is each once, whatever its form."""
    known: dict[str, Any] = {}
    for value in values:
        known.setdefault(text_of(value), value)
    return list(known.values())


def _repeats(sizes: Sequence[int]) -> bool:
    """Whether a size is there twice, as it may be in a network, but not among values to try."""
    return len(_once(sizes)) < len(sizes)


def _written(values: Sequence[Any]) -> str:
    """Return a list as it is written in a sweep file; a long one is not repeated."""
    text = repr(list(values))
    return text if len(text) <= _MOST_SHOWN else "[...]"


def _layers(number: int) -> str:
    return "one layer" if number == 1 else f"{number} layers"

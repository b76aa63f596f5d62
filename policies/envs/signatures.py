"""What can be given to functions and methods."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from typing import Any


def signature(function: Callable[..., Any]) -> inspect.Signature:
    """Return what a function, a class or a method takes, without evaluating its annotations.

    Raises:
        TypeError: It cannot be called.
        ValueError: It does not say what it takes, as some functions that are written in C.
    """
    if sys.version_info >= (3, 14):
        # Annotations are evaluated as late as here, and may name what is imported for type checkers alone.
        from annotationlib import Format

        return inspect.signature(function, annotation_format=Format.STRING)
    return inspect.signature(function)


def named_parameters(function: Callable[..., Any] | None) -> frozenset[str]:
    """Return the names of what can be given to a function by its name; of None, which is not known, none."""
    if function is None:
        return frozenset()
    parameters = signature(function).parameters.values()
    return frozenset(p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY))


def takes_any_name(function: Callable[..., Any] | None) -> bool:
    """Whether a function takes arguments of any name; None, which is not known, may take them."""
    if function is None:
        return True
    return any(p.kind is p.VAR_KEYWORD for p in signature(function).parameters.values())


def needs_nothing(method: Any) -> bool:
    """Whether something is a method that needs no arguments; Taxi's `action_mask(state)` does."""
    try:
        signature(method).bind()
    except (TypeError, ValueError):
        return False
    return True

"""What can be given to functions and methods."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any


def named_parameters(function: Callable[..., Any] | None) -> frozenset[str]:
    """Return the names of what can be given to a function by its name; of None, which is not known, none."""
    if function is None:
        return frozenset()
    parameters = inspect.signature(function).parameters.values()
    return frozenset(p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY))


def takes_any_name(function: Callable[..., Any] | None) -> bool:
    """Whether a function takes arguments of any name; None, which is not known, may take them."""
    if function is None:
        return True
    return any(p.kind is p.VAR_KEYWORD for p in inspect.signature(function).parameters.values())


def needs_nothing(method: Any) -> bool:
    """Whether something is a method that needs no arguments; Taxi's `action_mask(state)` does."""
    try:
        inspect.signature(method).bind()
    except (TypeError, ValueError):
        return False
    return True

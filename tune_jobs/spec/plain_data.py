"""Copy a sweep's fields as plain JSON-like data, which a sweep folder can hold, within limits of size."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import numpy as np
from pydantic import BaseModel

from policies.errors import SpecError, shortened

MAX_CHARACTERS = 262_144
MAX_VALUES = 50_000
MAX_DEPTH = 64
"""The most levels of nested lists and mappings."""
MAX_DIGITS = 40
"""The most digits of a whole number; seeds may have 128 bits."""

_SMALLER = "Make it smaller: a sweep's fields hold settings, not data."


def to_plain(value: Any, label: str) -> Any:
    """Return a copy with only dicts with strings as keys, lists, strings, finite numbers, booleans and None.

    NumPy's numbers, booleans, strings and arrays become Python's; paths become strings, and pydantic models dicts.

    Args:
        value: The data of a sweep file or a Python call.
        label: Its name in messages.

    Raises:
        SpecError: It has a value of another kind, or is larger than the limits; the message says where.
    """
    return _Copy(label).of(value, "")


def yaml_text(value: Any) -> str:
    """Return a value as messages show it: with YAML's words true, false and null, cut to at most 80 characters."""
    if isinstance(value, list | tuple):
        text = f"[{', '.join(map(yaml_text, value))}]"
        return text if len(text) <= 80 else f"{text[:77]}..."
    if value is None:
        return "null"
    return str(value).lower() if isinstance(value, bool) else shortened(value)


def _instead_of(value: Any, path: str) -> str:
    """Return what to give in place of an object; classes of environments have been replaced by their names already."""
    is_env = path in ("env", "env.id") and not isinstance(value, type)
    if is_env and hasattr(type(value), "step"):
        return (
            "Give the class itself, with its arguments under args, as in {'id': MyEnv, 'args': {...}}; or a Gymnasium "
            "id."
        )
    if is_env and callable(value):
        return (
            "Register it with gymnasium.register in a module of your own, and give the id after the module, as in "
            "my_envs:Name-v0."
        )
    if path.startswith(("space.", "hyperparams.")):
        return (
            "Give values as they are, and write a domain as a mapping under space, as in {'lr': {'loguniform': [1e-5, "
            "1e-3]}, 'num_epochs': {'grid': [4, 8]}}; no objects and no functions."
        )
    return "Give texts, numbers, true or false, None, lists and mappings of them."


class _Copy:
    def __init__(self, label: str) -> None:
        self._label = label
        self._num_values = 0
        self._num_characters = 0
        self._above: set[int] = set()

    def of(self, value: Any, path: str) -> Any:
        value = self._of_python(value, path)
        self._count(path, values=1)
        if isinstance(value, Mapping | list | tuple):
            return self._container(value, path)
        if isinstance(value, str):
            self._count(path, characters=len(value))
            self._check_text(value, path)
            # Only str itself, not a subclass such as an enum's member.
            return str.__str__(value)
        if isinstance(value, int | float) and not isinstance(value, bool):
            return self._number(value, path)
        if value is None or isinstance(value, bool):
            return value
        kind = f"the class {value.__qualname__}" if isinstance(value, type) else f"of type {type(value).__name__}"
        raise self._error(path, f"{shortened(value)} is {kind}, which JSON can't hold", _instead_of(value, path))

    def _of_python(self, value: Any, path: str) -> Any:
        """Return NumPy's values, paths and models as Python's own types."""
        if isinstance(value, BaseModel):
            # Field by field, because model_dump would copy everything before it is counted.
            return dict(value)
        if isinstance(value, np.ndarray | np.generic):
            if value.size > MAX_VALUES:
                self._count(path, values=value.size)
            return value.tolist()
        return str(value) if isinstance(value, PurePath) else value

    def _number(self, value: float, path: str) -> int | float:
        if isinstance(value, int):
            if abs(value) >= 10**MAX_DIGITS:
                raise self._error(path, f"has a whole number of more than {MAX_DIGITS} digits", "Give a smaller one.")
            return int(value)
        if not math.isfinite(value):
            raise self._error(path, f"{float(value)!r} is not a finite number", "Give a finite number.")
        return float(value)

    def _container(self, value: Mapping[Any, Any] | list[Any] | tuple[Any, ...], path: str) -> Any:
        if id(value) in self._above:
            raise self._error(path, "contains itself", "Take out the part that is the same object as the whole.")
        if len(self._above) >= MAX_DEPTH:
            raise self._error(path, f"is nested more than {MAX_DEPTH} deep", _SMALLER)
        self._above.add(id(value))
        try:
            if not isinstance(value, Mapping):
                return [self.of(item, f"{path}[{index}]") for index, item in enumerate(value)]
            copied = {}
            for key, item in value.items():
                name = self._key(key, path)
                if name in copied:
                    raise self._error(path, f"has the key {name!r} twice, as a number and as a text", "Keep one.")
                copied[name] = self.of(item, f"{path}.{name}" if path else name)
            return copied
        finally:
            self._above.remove(id(value))

    def _key(self, key: Any, path: str) -> str:
        if isinstance(key, bool) or not isinstance(key, str | int | np.integer):
            raise self._error(path, f"has the key {shortened(key)}, which is not a text", "Use texts as keys.")
        self._count(path, characters=len(name := str(key)))
        self._check_text(name, path)
        return name

    def _check_text(self, text: str, path: str) -> None:
        """Refuse half of a surrogate pair, which no file could hold."""
        try:
            text.encode()
        except UnicodeEncodeError as error:
            half = ascii(text[error.start])
            raise self._error(
                path, f"{shortened(text)} has {half}, which is half a character", "Take that character out."
            ) from None

    def _count(self, path: str, *, values: int = 0, characters: int = 0) -> None:
        self._num_values += values
        self._num_characters += characters
        if self._num_values > MAX_VALUES:
            raise self._error(path, f"more than {MAX_VALUES:,} values up to here", _SMALLER)
        if self._num_characters > MAX_CHARACTERS:
            raise self._error(path, f"more than {MAX_CHARACTERS:,} characters up to here", _SMALLER)

    def _error(self, path: str, problem: str, hint: str) -> SpecError:
        shown = path if len(path) <= 80 else f"{path[:60]}..."
        return SpecError(f"{self._label}: {shown}{': ' if shown else ''}{problem}", hint)

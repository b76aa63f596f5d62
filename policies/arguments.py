"""The arguments of public functions, checked against their annotations before anything is done with them.

A wrong argument is reported at once, by its name, instead of causing an error deeper in the code. NumPy's numbers
become Python's, and paths of other libraries become pathlib's.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import math
import numbers
import os
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

from policies.errors import SpecError, shortened
from policies.suggestions import did_you_mean

_P = ParamSpec("_P")
_R = TypeVar("_R")
_WRONG = object()
_LONGEST_NAME, _LONGEST_PATH = 255, 4096


class Range(NamedTuple):
    """The range of a number, both ends included; for use in `Annotated`."""

    low: int
    high: int | None = None


Seed = Annotated[int, Range(0, 2**32 - 1)]
PositiveInt = Annotated[int, Range(1)]
Seconds = Annotated[float, Range(0, 10**9)]
NumEpisodes = Annotated[int, Range(1, 2**18)]
Inches = Annotated[float, Range(1, 100)]


def checked(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function so that its arguments are checked against its annotations.

    NumPy's errors are what they are by default while it runs, whatever the caller has made of them.

    Raises:
        SpecError: Raised by the decorated function when an argument has a wrong type.
    """
    signature = inspect.signature(function)

    @functools.cache
    def kinds() -> dict[str, Any]:
        # Without the type of the result, which may be imported for type checkers only.
        given = {name: kind for name, kind in function.__annotations__.items() if name != "return"}
        holder = types.SimpleNamespace(__annotations__=given)
        return get_type_hints(holder, globalns=inspect.unwrap(function).__globals__, include_extras=True)

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError as error:
            # Python's own message would name the function; that of `bind` does not.
            unknown = [name for name in kwargs if name not in signature.parameters]
            nearest = did_you_mean(unknown[0], signature.parameters) if unknown else ""
            takes = f"it takes {', '.join(signature.parameters)}"
            raise TypeError(f"{function.__name__}() {error}: {takes}.{nearest}") from None
        for name, value in bound.arguments.items():
            bound.arguments[name] = fit_argument(name, value, kinds()[name])
        with _numpys_own_errors():
            return function(*bound.args, **bound.kwargs)

    return call


def _numpys_own_errors() -> AbstractContextManager[object]:
    """Undo what the caller set of NumPy's errors in the block.

    Where that says "raise", the exponential of -1,000 is one.
    """
    # Not there before NumPy is imported, or while another thread does that.
    errstate: Any = getattr(sys.modules.get("numpy"), "errstate", None)
    if errstate is None:
        return contextlib.nullcontext()
    own: AbstractContextManager[object] = errstate(divide="warn", over="warn", under="ignore", invalid="warn")
    return own


def fit_argument(name: str, value: Any, kind: Any) -> Any:
    """Return an argument as a checked function gets it: converted to its kind, which is as annotations name it.

    Raises:
        SpecError: It is of another kind.
    """
    fitted = _fit(value, kind)
    if fitted is _WRONG:
        raise SpecError(f"The argument {name} is {shortened(value)}.", f"Give {_words(kind)}.")
    return fitted


def _fit(value: Any, kind: Any) -> Any:
    """Return the value converted to the kind, or `_WRONG` where it does not fit."""
    origin = get_origin(kind)
    if origin in (Union, types.UnionType):
        return _fit_one_of(value, get_args(kind))
    if origin is Literal:
        return value if isinstance(value, str) and value in get_args(kind) else _WRONG
    if origin is Annotated:
        return _fit_range(value, *get_args(kind))
    if origin in (Sequence, Iterable):
        return _fit_items(value, origin, get_args(kind)[0])
    if kind in _FITS:
        return _FITS[kind](value)
    return value if kind is Any or isinstance(value, origin or kind) else _WRONG


def _fit_one_of(value: Any, kinds: tuple[Any, ...]) -> Any:
    if isinstance(value, str) and Path in kinds and not _can_be_path(value):
        return _WRONG
    return next((fitted for kind in kinds if (fitted := _fit(value, kind)) is not _WRONG), _WRONG)


def _fit_range(value: Any, kind: Any, limits: Range) -> Any:
    number = _fit(value, kind)
    inside = number is not _WRONG and limits.low <= number and (limits.high is None or number <= limits.high)
    return number if inside else _WRONG


def _fit_items(value: Any, container: Any, kind: Any) -> Any:
    if _is_numpys("ndarray", value):
        value = value.tolist()
    # A string is a sequence of letters too, but nobody means that.
    if isinstance(value, str | bytes | bytearray | Mapping) or not isinstance(value, container):
        return _WRONG
    items = tuple(_fit(item, kind) for item in value)
    return _WRONG if any(item is _WRONG for item in items) else items


def _text(value: Any) -> Any:
    return str(value) if isinstance(value, str) else _WRONG


def _path(value: Any) -> Any:
    if not isinstance(value, os.PathLike):
        return _WRONG
    text = os.fspath(value)
    return Path(text) if isinstance(text, str) and _can_be_path(text) else _WRONG


def _can_be_path(text: str) -> bool:
    """Whether the operating system accepts this as a path."""
    try:
        data = os.fsencode(text)
    except UnicodeEncodeError:
        return False
    longest = max(map(len, data.split(b"/")))
    return bool(data) and b"\0" not in data and longest <= _LONGEST_NAME and len(data) < _LONGEST_PATH


def _flag(value: Any) -> Any:
    return bool(value) if isinstance(value, bool) or _is_numpys("bool_", value) else _WRONG


def _scalar(value: Any) -> Any:
    return value[()] if _is_numpys("ndarray", value) and value.ndim == 0 else value


def _is_numpys(kind: str, value: Any) -> bool:
    """Whether a value is of that class of NumPy; NumPy is not imported for it, so that the command line is fast."""
    numpy = sys.modules.get("numpy")
    return numpy is not None and isinstance(value, getattr(numpy, kind))


def _whole(value: Any) -> Any:
    value = _scalar(value)
    return int(value) if isinstance(value, numbers.Integral) and not isinstance(value, bool) else _WRONG


def _number(value: Any) -> Any:
    value = _scalar(value)
    is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    return float(value) if is_number and math.isfinite(value) else _WRONG


_FITS: dict[Any, Callable[[Any], Any]] = {str: _text, Path: _path, bool: _flag, int: _whole, float: _number}
_PATH_WORDS = f"a name or path (not empty, each part at most {_LONGEST_NAME} bytes)"
_NAMES = {
    str: "a text", Path: _PATH_WORDS, bool: "True or False", int: "a whole number", float: "a number",
    type(None): "None", Mapping: "a mapping", type: "a class",
}  # fmt: skip


def _words(kind: Any) -> str:
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        # Where a path may be given too, a string is taken for a path.
        named = [_words(part) for part in parts if part is not str or Path not in parts]
        return " or ".join(named)
    if origin is Literal:
        return " or ".join(map(repr, parts))
    if origin is Annotated:
        low, high = parts[1]
        number = _words(parts[0])
        return f"{number} from {low:,} to {high:,}" if high is not None else f"{number} of at least {low:,}"
    if origin in (Sequence, Iterable):
        return f"a list, each of its items {_words(parts[0])}"
    known = origin or kind
    return _NAMES.get(known, f"a {getattr(known, '__name__', known)}")

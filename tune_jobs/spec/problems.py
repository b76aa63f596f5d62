"""The problems of a sweep, in words of the sweep file in place of pydantic's messages."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, Self

from policies.errors import SpecError

SPEC_HINT = "Correct it and launch again; `tune-jobs schema` prints every field, `tune-jobs presets` lists examples."


class Problem(NamedTuple):
    """One thing that is wrong with a sweep."""

    path: str
    """Its dotted path in the sweep file."""
    text: str
    """The description of what is wrong there."""


class WrongSpecError(SpecError):
    """A sweep is wrong; `problems` are all that was found, and the message lists them."""

    problems: tuple[Problem, ...] = ()

    @classmethod
    def of(cls, label: str, problems: Iterable[Problem]) -> Self:
        """Return the error for a sweep.

        Args:
            label: The sweep's name in the message.
            problems: What is wrong, and where; a problem that occurs twice is listed once.
        """
        found = tuple(dict.fromkeys(problems))
        lines = [f"{path}: {text}" if path else text for path, text in found]
        told = lines[0] if len(lines) == 1 else "\n  ".join([f"{len(lines)} problems:", *lines])
        error = cls(f"{label}: {told}", SPEC_HINT)
        error.problems = found
        return error

"""What is wrong with a sweep, in the words of its writer: pydantic finds it, and is not quoted."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, Self

from policies.errors import SpecError

SPEC_HINT = "Correct it and launch again; `tune-jobs schema` prints every field, `tune-jobs presets` lists examples."


class Problem(NamedTuple):
    """One thing that is wrong with a sweep."""

    path: str
    """Dotted path in the sweep file."""
    text: str
    """What is wrong there."""


class WrongSpecError(SpecError):
    """A sweep is wrong; `problems` are all that is, the message tells them."""

    problems: tuple[Problem, ...] = ()

    @classmethod
    def of(cls, label: str, problems: Iterable[Problem]) -> Self:
        """The error for a sweep.

        Args:
            label: What the message calls the sweep.
            problems: What is wrong, and where; what stands there twice is told once.
        """
        found = tuple(dict.fromkeys(problems))
        lines = [f"{path}: {text}" if path else text for path, text in found]
        told = lines[0] if len(lines) == 1 else "\n  ".join([f"{len(lines)} problems:", *lines])
        error = cls(f"{label}: {told}", SPEC_HINT)
        error.problems = found
        return error

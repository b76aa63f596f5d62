"""Errors raised on purpose: each says what is wrong, where, and what to do next.

Hierarchy: every error below is a `TuneJobsError`; the subclass decides the exit code of the command line.
"""

from __future__ import annotations

from typing import Any, ClassVar


class TuneJobsError(Exception):
    """Base class: catching it catches every error raised on purpose.

    Args:
        message: What is wrong, with the offending value and where it came from.
        hint: What to do next, as an imperative sentence; may name a command.
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, message: str, hint: str = "") -> None:
        # Both go to Exception.args, or the error cannot be unpickled when Ray carries it between processes.
        super().__init__(message, hint)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        """Message and hint, the hint on a line of its own."""
        return f"{self.message}\n{self.hint}" if self.hint else self.message


class SpecError(TuneJobsError):
    """A sweep file, an option or an argument is wrong; nothing was started."""

    exit_code = 2


class EnvError(SpecError):
    """An environment is not registered, cannot be made, or does not go with the algorithm."""


class EnvFailedError(EnvError):
    """An environment raised an error, hung, or ended its process while it ran."""


class TrialsFailedError(TuneJobsError):
    """The sweep finished but some trials failed."""

    exit_code = 3


class NotFoundError(TuneJobsError):
    """No such sweep, trial, checkpoint or policy file."""

    exit_code = 4


class CheckpointError(NotFoundError):
    """A checkpoint or policy file is there but incomplete, altered, or of another kind."""


class CannotRunError(TuneJobsError):
    """This machine or cluster cannot run it: resources, storage, address."""

    exit_code = 5


def shortened(value: Any) -> str:
    """A value's repr, at most 80 characters of it."""
    try:
        text = repr(value)
    except Exception:  # noqa: BLE001 - an object of a user's own may raise anything
        return "a value"
    return text if len(text) <= 80 else f"{text[:77]}..."


MALFORMED = (
    ArithmeticError, AssertionError, AttributeError, LookupError, MemoryError, RecursionError, TypeError, ValueError,
)  # fmt: skip
"""What data of another kind than was expected raises; who reads a file turns these into a `CheckpointError`."""

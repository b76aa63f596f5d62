"""Errors raised on purpose: each says what is wrong, where, and what to do next.

Hierarchy: every error below is a `TuneJobsError`; the subclass decides the exit code of the command line.
"""

from __future__ import annotations

import re
import traceback
from typing import Any, ClassVar

# Halves of surrogate pairs, which no file takes, and what moves a terminal's cursor; not the ends of lines, nor tabs.
_UNFIT = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
_MAX_SAID = 2_000


class TuneJobsError(Exception):
    """Base class: catching it catches every error raised on purpose.

    Args:
        message: What is wrong, with the offending value and where it came from.
        hint: What to do next, as an imperative sentence; may name a command.
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, message: str, hint: str = "") -> None:
        # It quotes what others wrote, and goes into files and to terminals.
        message, hint = fit(message), fit(hint)
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


def fit(text: str, max_length: int | None = None) -> str:
    """A text such as every file and terminal takes it.

    Args:
        text: Any text.
        max_length: Of what is longer the middle is left out, and said so; None: nothing is.
    """
    if max_length is not None and len(text) > max_length:
        end = max_length // 4
        left_out = len(text) - max_length
        text = f"{text[: max_length - end]} [... {left_out:,} characters ...] {text[len(text) - end :]}"
    return _UNFIT.sub(lambda found: found.group().encode("unicode_escape").decode("ascii"), text)


def said_by(error: BaseException) -> str:
    """What an exception of somebody else's says, without a dot at its end: it may be anything, megabytes too."""
    try:
        text = str(error)
    except Exception:  # noqa: BLE001 (its own `__str__` fails)
        return "it cannot be shown"
    return fit(text.strip(), _MAX_SAID).rstrip(".")


def tellable(error: Exception) -> Exception:
    """The exception, or one that says the same, if its traceback holds what is no text: Ray 2.60 can't carry that."""
    try:
        "".join(traceback.format_exception(error)).encode()
    except UnicodeEncodeError:
        if isinstance(error, TuneJobsError):
            # Its words are fit; those of what it was raised for are not.
            return type(error)(error.message, error.hint)
        return TuneJobsError(f"{type(error).__name__}: {said_by(error)}")
    return error


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


class ObservationError(TuneJobsError):
    """An observation is not of the shape that the policy takes."""


class NonFiniteWeightsError(TuneJobsError):
    """A network holds NaN or infinite weights: its training went wrong, and what it does means nothing."""

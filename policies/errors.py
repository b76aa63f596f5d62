"""Errors raised on purpose: each says what is wrong, where, and what to do next.

Hierarchy: every error below is a `TuneJobsError`; the subclass decides the exit code of the command line.
"""

from __future__ import annotations

import copy
import re
import traceback
from typing import Any, ClassVar, Self

# Halves of surrogate pairs, which cannot be written to files, and control characters except newlines and tabs.
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
        # Messages quote texts of others, and are written to files and terminals.
        message, hint = fit(message), fit(hint)
        # Both go to Exception.args, or the error cannot be unpickled when Ray carries it between processes.
        super().__init__(message, hint)
        self.message = message
        self.hint = hint

    def again(self, message: str | None = None, hint: str | None = None) -> Self:
        """Return the same error, with all that it says of itself, to be raised once more.

        Args:
            message: What it says instead; None: the same.
            hint: What it advises instead; None: the same.
        """
        other = copy.copy(self)
        other.message = self.message if message is None else fit(message)
        other.hint = self.hint if hint is None else fit(hint)
        other.args = (other.message, other.hint)
        return other

    def __str__(self) -> str:
        """Return the message and the hint, the hint on a line of its own."""
        return f"{self.message}\n{self.hint}" if self.hint else self.message


class SpecError(TuneJobsError):
    """A sweep file, an option or an argument is wrong; nothing was started."""

    exit_code = 2


class EnvError(SpecError):
    """An environment is not registered, cannot be made, or does not fit the algorithm."""


class EnvFailedError(EnvError):
    """An environment raised an error, hung, or ended its process while it ran."""


class TrialsFailedError(TuneJobsError):
    """The sweep has finished, but some of its trials failed."""

    exit_code = 3


class NotFoundError(TuneJobsError):
    """There is no such sweep, trial, checkpoint or policy file."""

    exit_code = 4


class CheckpointError(NotFoundError):
    """A checkpoint or policy file exists, but it is incomplete, altered, or of another kind."""


class CannotRunError(TuneJobsError):
    """This machine or cluster cannot run it, because of its resources, its storage or its address."""

    exit_code = 5


def fit(text: str, max_length: int | None = None) -> str:
    """Return a text with all characters escaped that a file or a terminal could not take.

    Args:
        text: Any text.
        max_length: If the text is longer, its middle is replaced by a note; None: the text is not cut.
    """
    if max_length is not None and len(text) > max_length:
        end = max_length // 4
        left_out = len(text) - max_length
        text = f"{text[: max_length - end]} [... {left_out:,} characters ...] {text[len(text) - end :]}"
    return _UNFIT.sub(lambda found: found.group().encode("unicode_escape").decode("ascii"), text)


def said_by(error: BaseException) -> str:
    """Return the message of any exception, without a full stop at its end; a very long one is cut."""
    try:
        text = str(error)
    except Exception:  # noqa: BLE001 (its own `__str__` fails)
        return "it cannot be shown"
    return fit(text.strip(), _MAX_SAID).rstrip(".")


def tellable(error: Exception) -> Exception:
    """Return the exception, or one with its message if its traceback is no valid text, which Ray 2.60 can't send."""
    try:
        "".join(traceback.format_exception(error)).encode()
    except UnicodeEncodeError:
        if isinstance(error, TuneJobsError):
            # Its own message is valid text; that of its cause is not.
            return error.again()
        return TuneJobsError(f"{type(error).__name__}: {said_by(error)}")
    return error


def shortened(value: Any) -> str:
    """Return a value's repr, cut to at most 80 characters."""
    try:
        text = repr(value)
    except Exception:  # noqa: BLE001 - an object of a user's own may raise anything
        return "a value"
    return text if len(text) <= 80 else f"{text[:77]}..."


MALFORMED = (
    ArithmeticError, AssertionError, AttributeError, LookupError, MemoryError, RecursionError, TypeError, ValueError,
)  # fmt: skip
"""The exceptions that unexpected data raises; code that reads a file turns them into a `CheckpointError`."""

UPGRADE = "Upgrade tune-jobs: install it again from its repository, after `git pull` there, or from a newer wheel."
"""What to do about what a newer version wrote. By its name alone pip would look for it in an index, which has none."""


class ObservationError(TuneJobsError):
    """An observation does not have the shape that the policy takes."""


class NonFiniteWeightsError(TuneJobsError):
    """A network has NaN or infinite weights: its training failed, and its actions mean nothing."""

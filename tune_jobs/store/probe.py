"""Find out whether other machines can use the same sweep folder as this one, before the sweep runs on them.

The process that holds the sweep's lock asks. Each machine reads the question, leaves an answer beside it, and tries
everything else that trials do there: list, lock and delete.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, Protocol, get_args

from policies.errors import CannotRunError, said_by
from policies.files import read_regular, write_atomic
from tune_jobs.store.names import PROBE_FOLDER
from tune_jobs.store.places import within

Operation = Literal["read", "write", "list", "lock", "delete"]
"""What a machine must be able to do at a sweep's place. To lock is to be the only one who makes something."""

OPERATIONS: tuple[Operation, ...] = get_args(Operation)

_QUESTION = "question"
_HELD = "held"
_MAX_QUESTION_BYTES = 1_000
_MOST_REMOVALS = 3


class FailedOperationError(CannotRunError):
    """A machine cannot do one of the operations.

    Args:
        operation: The one of `OPERATIONS`.
        reason: Why, as a phrase.
    """

    def __init__(self, operation: str, reason: str) -> None:
        super().__init__(f"cannot {operation}: {reason}")
        # Both go to Exception.args, or the error cannot be unpickled when Ray carries it between processes.
        self.args = (operation, reason)
        self.operation, self.reason = operation, reason


class Probe(Protocol):
    """A question that other machines answer, where a sweep is."""

    @property
    def place(self) -> str:
        """The text that a machine has to pass to `opening.answer`."""
        ...

    def is_same(self, question: str, machine: str) -> bool:
        """Whether a machine has read this question, and its answer can be seen here.

        Args:
            question: The result of `answer` on that machine.
            machine: The machine's name, as passed to `answer`.
        """
        ...


class FolderProbe:
    """A question in a sweep's folder; implements `Probe`.

    Args:
        folder: The folder of the question and the answers.
        token: The question, a random text.
    """

    def __init__(self, folder: Path, token: str) -> None:
        self._folder, self._token = folder, token

    @property
    def place(self) -> str:
        """The text that a machine has to pass to `answer`."""
        return str(self._folder)

    def is_same(self, question: str, machine: str) -> bool:
        """Whether a machine has read this question, and its answer can be seen here."""
        try:
            return question == self._token == (self._folder / machine).read_text(encoding="utf-8")
        except OSError:
            return False


@contextlib.contextmanager
def probing(sweep_folder: Path) -> Iterator[FolderProbe]:
    """Ask a question in a sweep's folder, and remove it with its answers after the block.

    Raises:
        CannotRunError: The folder cannot be written.
    """
    folder = within(sweep_folder, PROBE_FOLDER)
    folder.mkdir(parents=True, exist_ok=True)
    token = secrets.token_hex(8)
    write_atomic(folder / _QUESTION, token)
    try:
        with _locked(folder / _HELD):
            yield FolderProbe(folder, token)
    finally:
        _remove(folder)


def _remove(folder: Path) -> None:
    """Remove the question and its answers; what can't be is left to the next run, and hides no error of this one."""
    for _ in range(_MOST_REMOVALS):
        with contextlib.suppress(OSError):
            for path in folder.iterdir():
                path.unlink(missing_ok=True)
            # A process of a node that was lost meanwhile, and that nobody waits for, may write just now.
            folder.rmdir()
            return


def answer(place: str, machine: str) -> str:
    """Read the question on another machine, leave an answer, and try what trials do there.

    Args:
        place: The probe's place.
        machine: A name of this machine.

    Raises:
        FileNotFoundError: The folder cannot be seen here.
        FailedOperationError: An operation fails here, or does not do what it says.
    """
    folder = Path(place)
    own, scratch = folder / machine, folder / f"{machine}.scratch"
    with _trying("read"):
        question = read_regular(folder / _QUESTION, _MAX_QUESTION_BYTES).decode("utf-8", "replace")
    with _trying("write"):
        write_atomic(own, question)
    with _trying("list"):
        listed = {path.name for path in folder.iterdir()}
        if not {_QUESTION, machine} <= listed:
            raise FailedOperationError("list", "files that are there are not listed")
    with _trying("lock"):
        with _locked(scratch):
            pass
        if _can_lock(folder / _HELD):
            raise FailedOperationError("lock", "a lock that another machine holds is not seen there")
    with _trying("delete"):
        scratch.unlink()
        if scratch.exists():
            raise FailedOperationError("delete", "a file that was deleted is still there")
    return question


@contextlib.contextmanager
def _trying(operation: Operation) -> Iterator[None]:
    """Say which operation failed.

    Raises:
        FileNotFoundError: Nothing is there to read, so that the folder is not the same one.
        FailedOperationError: Any other error of the system.
    """
    try:
        yield
    except FailedOperationError:
        raise
    except FileNotFoundError:
        if operation == "read":
            raise
        raise FailedOperationError(operation, "the folder is gone") from None
    except OSError as error:
        raise FailedOperationError(operation, error.strerror or said_by(error)) from error
    except CannotRunError as error:
        cause = error.__cause__
        said = cause.strerror if isinstance(cause, OSError) else None
        raise FailedOperationError(operation, said or said_by(error)) from error


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def _can_lock(path: Path) -> bool:
    try:
        with _locked(path):
            return True
    except BlockingIOError:
        return False

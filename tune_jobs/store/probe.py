"""Find out whether other machines see the same sweep folder as this one, before the sweep runs on them.

The process that holds the sweep's lock asks; each machine reads the question and leaves an answer beside it.
"""

from __future__ import annotations

import contextlib
import secrets
from collections.abc import Iterator
from pathlib import Path

from policies.files import write_atomic
from tune_jobs.store.names import PROBE_FOLDER
from tune_jobs.store.places import within

_QUESTION = "question"


class Probe:
    """A question in a sweep's folder.

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
        """Whether a machine has read this question, and its answer can be seen here.

        Args:
            question: The result of `answer` on that machine.
            machine: The machine's name, as passed to `answer`.
        """
        try:
            return question == self._token == (self._folder / machine).read_text(encoding="utf-8")
        except OSError:
            return False


@contextlib.contextmanager
def probing(sweep_folder: Path) -> Iterator[Probe]:
    """Ask a question in a sweep's folder, and remove it with its answers after the block.

    Raises:
        CannotRunError: The folder cannot be written.
    """
    folder = within(sweep_folder, PROBE_FOLDER)
    folder.mkdir(parents=True, exist_ok=True)
    token = secrets.token_hex(8)
    write_atomic(folder / _QUESTION, token)
    try:
        yield Probe(folder, token)
    finally:
        for path in folder.iterdir():
            path.unlink(missing_ok=True)
        folder.rmdir()


def answer(place: str, machine: str) -> str:
    """Read the question on another machine, and leave an answer.

    Args:
        place: The probe's place.
        machine: A name of this machine.

    Raises:
        FileNotFoundError: The folder cannot be seen here.
    """
    question = Path(place, _QUESTION).read_text(encoding="utf-8")
    write_atomic(Path(place, machine), question)
    return question

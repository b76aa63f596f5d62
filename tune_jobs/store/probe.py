"""Whether other machines see the very folder of a sweep that is seen here: asked before the sweep runs on them.

Who holds the sweep's lock asks; each machine reads the question and leaves an answer beside it.
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
    """A question that was asked in a sweep's folder.

    Args:
        folder: Where question and answers lie.
        token: The question: chance.
    """

    def __init__(self, folder: Path, token: str) -> None:
        self._folder, self._token = folder, token

    @property
    def place(self) -> str:
        """What a machine is told, for `answer`."""
        return str(self._folder)

    def is_same(self, question: str, machine: str) -> bool:
        """Whether a machine has read the question that was asked, and its answer is seen here.

        Args:
            question: As `answer` returned it there.
            machine: As `answer` was told.
        """
        try:
            return question == self._token == (self._folder / machine).read_text(encoding="utf-8")
        except OSError:
            return False


@contextlib.contextmanager
def probing(sweep_folder: Path) -> Iterator[Probe]:
    """Ask in a sweep's folder, and leave nothing of it behind.

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
    """On another machine: read the question, and leave an answer.

    Args:
        place: Of the probe.
        machine: Which one this is.

    Raises:
        FileNotFoundError: The folder is not seen here.
    """
    question = Path(place, _QUESTION).read_text(encoding="utf-8")
    write_atomic(Path(place, machine), question)
    return question

"""Send standard output and error to a file while a sweep runs, and keep a stream to the real standard error."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from policies.errors import fit
from policies.files import open_to_append
from policies.standard_streams import has_standard_error
from tune_jobs.process.interruption import current


class _PatientStream(io.TextIOWrapper):
    """Drops what cannot be written, because the terminal or the reader of the pipe is gone; the sweep continues."""

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            return super().write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            super().flush()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            super().close()


_shown_on: list[_PatientStream] = []
"""The descriptor of the real standard error while number 2 is sent to a file."""


def standard_error() -> int:
    """Return the descriptor of the real standard error, also while number 2 is sent to a file; DEVNULL: there is none.

    Of a process that was started without it, number 2 may be a file of the user's.
    """
    if _shown_on:
        return _shown_on[-1].fileno()
    return 2 if has_standard_error() else subprocess.DEVNULL


def _stream() -> _PatientStream:
    number = standard_error()
    own = os.open(os.devnull, os.O_WRONLY) if number == subprocess.DEVNULL else os.dup(number)
    return _PatientStream(os.fdopen(own, "wb"), encoding="utf-8")


@contextlib.contextmanager
def patient_stream() -> Iterator[IO[str]]:
    """Yield a stream to the real standard error that drops what cannot be written there."""
    with _stream() as stream:
        yield stream


def say_at_last(text: str) -> None:
    """Write a text to the real standard error, in a process that is about to end."""
    for stream in _shown_on[-1:]:
        stream.write(f"{fit(text)}\n")
        stream.flush()


@contextlib.contextmanager
def quiet(log: Path) -> Iterator[IO[str]]:
    """Send standard output and error to a file, those of C++ code too; yields a stream to the real standard error."""
    _flush()
    with contextlib.ExitStack() as stack:
        file = stack.enter_context(open_to_append(log))
        stream = stack.enter_context(_stream())
        _shown_on.append(stream)
        stack.callback(_shown_on.remove, stream)
        stack.enter_context(_elsewhere(1, file))
        stack.enter_context(_elsewhere(2, file))
        try:
            yield stream
        finally:
            _flush()


@contextlib.contextmanager
def _elsewhere(number: int, file: IO[bytes]) -> Iterator[None]:
    """Redirect a descriptor of this process to a file."""
    original = os.dup(number)
    try:
        os.dup2(file.fileno(), number)
        yield
    finally:
        with current().shielded():
            os.dup2(original, number)
            os.close(original)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        # In a notebook these need not be files, and a terminal may be gone.
        with contextlib.suppress(OSError, ValueError):
            stream.flush()

"""Standard output and error while a sweep runs: sent to a file, beside a stream to the real standard error."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from policies.files import open_to_append
from tune_jobs.process.interruption import current


class _PatientStream(io.TextIOWrapper):
    """Drops what cannot be written: its terminal may have gone, or who read it from a pipe, and the sweep goes on."""

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
"""Where standard error leads to, while it is sent to a file."""


def standard_error() -> int:
    """The descriptor of the real standard error, wherever number 2 leads meanwhile."""
    return _shown_on[-1].fileno() if _shown_on else 2


def say_at_last(text: str) -> None:
    """Tell something on the real standard error, from a process that ends now."""
    for stream in _shown_on[-1:]:
        stream.write(f"{text}\n")
        stream.flush()


@contextlib.contextmanager
def quiet(log: Path) -> Iterator[IO[str]]:
    """Send standard output and error to a file, C++ included; gives a stream to the real standard error."""
    _flush()
    with contextlib.ExitStack() as stack:
        file = stack.enter_context(open_to_append(log))
        stream = stack.enter_context(_PatientStream(os.fdopen(os.dup(2), "wb"), encoding="utf-8"))
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
    """Let a descriptor of this process lead to a file."""
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
        # A notebook's need not be files; a terminal's may be gone.
        with contextlib.suppress(OSError, ValueError):
            stream.flush()

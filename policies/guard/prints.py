"""Send what a guard's child prints to standard error, or to the log of the sweep that is being finished."""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from pathlib import Path

from policies.errors import TuneJobsError
from policies.files import open_to_append


@functools.cache
def _first() -> int:
    return os.dup(2)


def print_to(log: str | None) -> None:
    """Send what this process prints from now on, C code's text too, to the end of a file.

    Args:
        log: The file; None: where this process's standard error went when it was first sent elsewhere.
    """
    if log is None and not _first.cache_info().currsize:
        return
    first = _first()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    with contextlib.ExitStack() as stack:
        to = first
        if log is not None:
            with contextlib.suppress(TuneJobsError):
                to = stack.enter_context(open_to_append(Path(log))).fileno()
        for number in (1, 2):
            with contextlib.suppress(OSError):
                os.dup2(to, number)

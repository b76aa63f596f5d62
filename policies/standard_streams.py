"""Open standard input, output and error in a process that was started without them, by a daemon for example.

Otherwise the next files that such a process opens get their descriptors, and what is printed goes into those files.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

_STREAMS = (("stdin", "r"), ("stdout", "w"), ("stderr", "w"))


@contextlib.contextmanager
def standard_streams() -> Iterator[None]:
    """Redirect the closed streams to nowhere in the block, also for child processes."""
    with contextlib.ExitStack() as stack:
        for number, (name, mode) in enumerate(_STREAMS):
            if not _is_open(number):
                # A new descriptor gets the lowest free number, which is this one.
                opened = os.open(os.devnull, os.O_RDWR)
                stack.callback(_close, opened)
                os.set_inheritable(opened, True)  # noqa: FBT003 (takes no keyword)
            if getattr(sys, name) is None:
                stack.callback(setattr, sys, name, None)
                setattr(sys, name, stack.enter_context(Path(os.devnull).open(mode, encoding="utf-8")))
        yield


def has_standard_error() -> bool:
    """Whether descriptor 2 is standard error; else it is closed, or a file that was opened where that was missing."""
    return sys.__stderr__ is not None and _is_open(2)


def for_child(name: Literal["stdout", "stderr"]) -> int | None:
    """Return what `Popen` is given for a child's stream: the one of this process, or nowhere if that has none."""
    import subprocess

    return subprocess.DEVNULL if getattr(sys, f"__{name}__") is None else None


def _is_open(number: int) -> bool:
    try:
        os.fstat(number)
    except OSError:
        return False
    return True


def _close(number: int) -> None:
    with contextlib.suppress(OSError):
        os.close(number)

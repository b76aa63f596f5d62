"""Entry functions for child processes, which make them find this package and not a user's folder of the same name.

A spawned process first imports the module of its function, and a user's own `policies` may come first on its path.
Importing `tune_jobs` decides which of the two the name means (see `tune_jobs/process/own_packages.py`). It is imported
by its name as a string here, because this package may not import it.
"""

from __future__ import annotations

import contextlib
import functools
import pkgutil
import signal
from collections.abc import Callable
from typing import Any

# With `-P`, nothing in the working directory can hide this package. The user's folders are added later.
BEGINNING = """\
import sys
sys.path.insert(0, {root!r})
import policies
del sys.path[0]
"""
"""How a program begins that is given to `python -P -c`; the root is the folder that holds this package."""
_BEGIN = "tune_jobs.process.own_packages:run"


class _ByName:
    """A function that is pickled by its name and looked up where it is unpickled."""

    def __init__(self, path: str) -> None:
        self._path = path

    def __call__(self, *args: Any) -> Any:
        return pkgutil.resolve_name(self._path)(*args)

    def __reduce__(self) -> tuple[Callable[[str], Any], tuple[str]]:
        return pkgutil.resolve_name, (self._path,)


def entry(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the target for a spawned `multiprocessing.Process` that runs a function defined at the top of a module."""
    return functools.partial(_ByName(_BEGIN), f"{function.__module__}:{function.__qualname__}")


def how_it_ended(code: int) -> str:
    """Return the words for the exit code of a process; a negative one is that of a signal, as in `subprocess`."""
    if code < 0:
        with contextlib.suppress(ValueError):
            return f"was killed by {signal.Signals(-code).name}"
    return f"ended with exit code {code}"

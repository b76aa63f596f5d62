"""Where child processes begin, so that they find this package and not a user's folder of the same name.

A spawned process imports the module of its function first, by a path that a user's own `policies` may come first on;
`tune_jobs` settles whose that name is (see `tune_jobs/process/own_packages.py`). It is named by text here,
as all that it may be in this package.
"""

from __future__ import annotations

import functools
import pkgutil
from collections.abc import Callable
from typing import Any

_BEGIN = "tune_jobs.process.own_packages:run"


class _ByName:
    """A function that is looked up by its name where it is unpickled."""

    def __init__(self, path: str) -> None:
        self._path = path

    def __call__(self, *args: Any) -> Any:
        return pkgutil.resolve_name(self._path)(*args)

    def __reduce__(self) -> tuple[Callable[[str], Any], tuple[str]]:
        return pkgutil.resolve_name, (self._path,)


def entry(function: Callable[..., Any]) -> Callable[..., Any]:
    """The target to give a `multiprocessing.Process` of the kind `spawn`, for a function at the top of a module."""
    return functools.partial(_ByName(_BEGIN), f"{function.__module__}:{function.__qualname__}")

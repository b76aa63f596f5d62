"""How commands that are told to people name a sweep: so that they find it from where it is told."""

from __future__ import annotations

import contextlib
import os
import shlex
from collections.abc import Iterator
from pathlib import Path

from policies.errors import CannotRunError
from policies.files import absolute
from tune_jobs.store.urls import folder_of, is_url, name_of_place, outer_place

DEFAULT_STORAGE = "sweeps"
_VARIABLE = "TUNE_JOBS_STORAGE"


def name_in_commands(place: str | Path) -> str:
    """Return how a command names a sweep, as a shell reads it.

    By its name in the default storage, `$TUNE_JOBS_STORAGE` or ./sweeps; elsewhere by its folder, and in an object
    store by its URL.

    Args:
        place: The sweep's place, an absolute folder or a URL.
    """
    place = str(place)
    if _is_in_default(place):
        return shlex.quote(name_of_place(place))
    return shlex.quote(place if is_url(place) else str(folder_of(place)))


@contextlib.contextmanager
def default_storage(place: str) -> Iterator[None]:
    """Let a storage be this process's default in the block: its sweeps are named by their names.

    Who is told how to go on asks the service that does this, which knows its sweeps by their names.
    """
    before = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = place
    try:
        yield
    finally:
        del os.environ[_VARIABLE]
        if before is not None:
            os.environ[_VARIABLE] = before


def _is_in_default(place: str) -> bool:
    storage = os.environ.get(_VARIABLE) or DEFAULT_STORAGE
    if is_url(place) or is_url(storage):
        return is_url(place) and outer_place(place) == storage
    # Where the working directory is gone, no relative folder is the sweep's.
    with contextlib.suppress(CannotRunError):
        return absolute(folder_of(storage).expanduser()) == folder_of(place).parent
    return False

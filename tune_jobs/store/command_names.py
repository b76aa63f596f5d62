"""How commands that are told to people name a sweep: so that they find it from where it is told."""

from __future__ import annotations

import contextlib
import os
import shlex
from collections.abc import Iterator
from pathlib import Path

from policies.errors import CannotRunError, SpecError
from policies.files import absolute
from tune_jobs.store.names import SWEEP_RECORD
from tune_jobs.store.urls import folder_of, is_url, name_of_place, outer_place

DEFAULT_STORAGE = "sweeps"
_SERVED: list[str] = []
"""The storages of services in this process."""


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


def watch_or_end(place: str | Path) -> str:
    """Return the hint of a sweep that is being run: how it is watched, and how it is ended."""
    named = name_in_commands(place)
    return f"Watch it with `tune-jobs status {named}`, or end it with `tune-jobs stop {named}`."


def name_taken(folder: Path, *, is_sweep: bool) -> SpecError:
    """Return the error for a new sweep in whose place there is something already.

    Args:
        folder: The place.
        is_sweep: Whether there is a sweep; else it is what a killed process left, or a link to what isn't there.
    """
    if folder.is_symlink() and not is_sweep and not folder.exists():
        return SpecError(
            f"{folder.name!r} in {folder.parent} is a link, and what it leads to isn't there: {folder.readlink()}.",
            "Bring that back, remove the link, or choose another name with --name.",
        )
    go_on = f", or continue it: `tune-jobs resume {name_in_commands(folder)}`"
    unfinished = f"; or, if it isn't being written just now, remove that folder: it has no {SWEEP_RECORD}"
    hint = f"Choose another name with --name{go_on if is_sweep else unfinished}."
    return SpecError(f"A sweep {folder.name!r} is already in {folder.parent}.", hint)


def still_driven(name: str) -> tuple[str, str]:
    """Return what is wrong, and what to do, where a cluster runs a sweep on for a process that has ended."""
    return (
        f"A cluster still runs sweep {name}, for a process that has ended.",
        "Try again in a minute: the cluster is ending the run.",
    )


@contextlib.contextmanager
def served(storage: str) -> Iterator[None]:
    """Name the sweeps of a storage by their names in the block: who is told how to go on asks the service that has it.

    Args:
        storage: The storage's place, an absolute folder or a URL.
    """
    _SERVED.append(storage)
    try:
        yield
    finally:
        _SERVED.remove(storage)


def _is_in_default(place: str) -> bool:
    if outer_place(place) in _SERVED:
        return True
    storage = os.environ.get("TUNE_JOBS_STORAGE") or DEFAULT_STORAGE
    if is_url(place) or is_url(storage):
        return is_url(place) and outer_place(place) == storage
    # Where the working directory is gone, no relative folder is the sweep's.
    with contextlib.suppress(CannotRunError):
        return absolute(folder_of(storage).expanduser()) == folder_of(place).parent
    return False

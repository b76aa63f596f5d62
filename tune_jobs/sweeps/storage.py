"""Find the folder that sweeps are stored in, and the folder of a new sweep."""

from __future__ import annotations

import os
from pathlib import Path

from policies.errors import SpecError
from policies.files import absolute
from tune_jobs.spec.sweep_spec import check_sweep_name
from tune_jobs.store.contract import Sweep
from tune_jobs.store.opening import is_url, open_storage

DEFAULT_STORAGE = "sweeps"


def storage_folder(storage: str | Path | None) -> Path:
    """Return the given folder, else $TUNE_JOBS_STORAGE, else ./sweeps, as an absolute path."""
    chosen = storage or os.environ.get("TUNE_JOBS_STORAGE") or DEFAULT_STORAGE
    return absolute(expanded(chosen))


def expanded(path: str | Path) -> Path:
    """Replace a ~ at the beginning of a path by a home folder; the ~ of an unknown user is kept as a name."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


def folder_at(place: str) -> Path:
    """Return the folder of a sweep that is in one.

    Raises:
        SpecError: The sweep is in an object store, and has none.
    """
    if is_url(place):
        raise SpecError(
            f"The sweep at {place} has no folder: it is in an object store.",
            "Use `place`, which every command and function takes, and the paths of single results in `artifacts`.",
        )
    return Path(place)


def shown_place(place: str) -> str | Path:
    """Return a place for a notebook, which makes a link of a folder."""
    return place if is_url(place) else Path(place)


def choose_store(name: str | None, stem: str, storage: Path) -> Sweep:
    """Choose the folder of a new sweep, without making it.

    Args:
        name: The name that was asked for; None: `stem`, with a number if it is taken.
        stem: Name of the sweep file or preset.
        storage: Folder for sweeps.

    Raises:
        SpecError: The name that was asked for is taken, or is not allowed as a folder's name.
    """
    kept = open_storage(storage)
    if name is not None:
        return kept.new_sweep(check_sweep_name(name))
    # Only the creation of the folder decides whether a name is free; this finds one that is likely free.
    number = 1
    while True:
        candidate = stem if number == 1 else f"{stem}-{number}"
        try:
            check_sweep_name(candidate)
        except SpecError as error:
            raise SpecError(
                f"The sweep would be called {candidate!r}, after its file; that is not allowed as a sweep's name.",
                f"Give another with --name (in Python name=). {error.hint}",
            ) from error
        if not kept.is_taken(candidate):
            return kept.sweep(candidate)
        number += 1


def stem_of(source: object) -> str:
    """Return the default name of a sweep from this source."""
    return Path(source).stem if isinstance(source, str | Path) else "sweep"


def create_store(name: str | None, stem: str, storage: Path) -> Sweep:
    """Make the folder of a new sweep; several processes at once each get one of their own.

    Args:
        name: The same as for `choose_store`.
        stem: The same as for `choose_store`.
        storage: The same as for `choose_store`.

    Raises:
        SpecError: In the same cases as `choose_store`.
        CannotRunError: The storage folder cannot be written.
    """
    while True:
        store = choose_store(name, stem, storage)
        try:
            store.create()
        except SpecError:
            # It was taken since it was chosen.
            if name is not None:
                raise
        else:
            return store

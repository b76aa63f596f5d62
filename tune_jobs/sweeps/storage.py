"""Where sweeps are kept, and which folder a new one gets."""

from __future__ import annotations

import os
from pathlib import Path

from policies.errors import SpecError
from policies.files import absolute
from tune_jobs.spec.sweep_spec import check_sweep_name
from tune_jobs.store.contract import Sweep
from tune_jobs.store.local_storage import open_storage

DEFAULT_STORAGE = "sweeps"


def storage_folder(storage: str | Path | None) -> Path:
    """The given folder, else $TUNE_JOBS_STORAGE, else ./sweeps; absolute."""
    chosen = storage or os.environ.get("TUNE_JOBS_STORAGE") or DEFAULT_STORAGE
    return absolute(expanded(chosen))


def expanded(path: str | Path) -> Path:
    """A path as its user means it, with ~ for a home folder; of a user that there is none of, it is a name like any."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


def choose_store(name: str | None, stem: str, storage: Path) -> Sweep:
    """The folder of a new sweep, not made yet.

    Args:
        name: The name that was asked for; None: `stem`, with a number if it is taken.
        stem: Name of the sweep file or preset.
        storage: Folder for sweeps.

    Raises:
        SpecError: The name that was asked for is taken, or is none that a folder can have.
    """
    kept = open_storage(storage)
    if name is not None:
        return kept.new_sweep(check_sweep_name(name))
    # Only the folder's own creation decides who has a name; this finds one that is likely free.
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
    """What a sweep from this source is called where nobody gives a name."""
    return Path(source).stem if isinstance(source, str | Path) else "sweep"


def create_store(name: str | None, stem: str, storage: Path) -> Sweep:
    """Make the folder of a new sweep; of several processes at once, each gets one of its own.

    Args:
        name: As `choose_store`.
        stem: As `choose_store`.
        storage: As `choose_store`.

    Raises:
        SpecError: As `choose_store`.
        CannotRunError: The storage folder cannot be written.
    """
    while True:
        store = choose_store(name, stem, storage)
        try:
            store.create()
        except SpecError:
            # Taken since it was looked for.
            if name is not None:
                raise
        else:
            return store

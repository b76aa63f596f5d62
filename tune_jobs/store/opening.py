"""Open a storage or a sweep by its place: a folder, or the URL of an object store. See `urls`."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

from policies.errors import CannotRunError
from tune_jobs.store.contract import Storage, Sweep
from tune_jobs.store.local_storage import LocalStorage
from tune_jobs.store.names import TRIALS_FOLDER
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.store.urls import folder_of, is_url, name_of_place, outer_place

__all__ = ["is_url", "name_for_commands", "open_storage", "open_sweep", "sweep_of_trial"]


def open_storage(place: str | Path) -> Storage:
    """Return the storage at a place, which need not exist.

    Raises:
        CannotRunError: The place is a URL, and there is no such store.
    """
    if is_url(place):
        _no_object_store(place)
    return LocalStorage(folder_of(place))


def open_sweep(place: str | Path) -> Sweep:
    """Return the sweep at a place, which need not exist yet.

    Raises:
        CannotRunError: The place is a URL, and there is no such store.
    """
    if is_url(place):
        _no_object_store(place)
    return SweepStore(folder_of(place))


def name_for_commands(sweep: Sweep) -> str:
    """Return how a command names a sweep: by its name in a storage folder, by its URL in an object store."""
    return sweep.place if is_url(sweep.place) else sweep.name


def sweep_of_trial(place: str | Path) -> Sweep | None:
    """Return the sweep that a trial's place is in; None: it is in none.

    Raises:
        CannotRunError: The place is a URL, and there is no such store.
    """
    trials = outer_place(str(place))
    if name_of_place(trials) != TRIALS_FOLDER:
        return None
    sweep = open_sweep(outer_place(trials))
    return sweep if sweep.exists() else None


def _no_object_store(place: str | Path) -> NoReturn:
    raise CannotRunError(f"{place} cannot be opened: there is no object store yet.", "Give a folder.")

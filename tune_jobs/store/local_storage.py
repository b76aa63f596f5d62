"""Sweeps in the folders of this machine, or of a network file system: the one store there is. See `contract`."""

from __future__ import annotations

from pathlib import Path, PurePath

from policies.errors import NotFoundError
from tune_jobs.store.contract import Storage, Sweep
from tune_jobs.store.sweep_store import SweepStore, list_sweep_stores, name_taken


def open_storage(folder: Path) -> Storage:
    """Where sweeps are kept, by its place."""
    return LocalStorage(folder)


def open_sweep(folder: Path) -> Sweep:
    """A sweep by its place, whether there is one yet or not."""
    return SweepStore(folder)


class LocalStorage:
    """A folder with one folder a sweep.

    Args:
        folder: The folder; need not be there.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def sweep(self, name: str) -> SweepStore:
        """See `Storage.sweep`."""
        if "\0" in name or name in ("", ".", "..") or PurePath(name).name != name:
            raise NotFoundError(f"{name[:80]!r} is no sweep's name.", "List the sweeps with `tune-jobs list`.")
        return SweepStore(self._folder / name)

    def new_sweep(self, name: str) -> SweepStore:
        """See `Storage.new_sweep`."""
        if self.is_taken(name):
            raise name_taken(self.sweep(name).folder)
        return self.sweep(name)

    def is_taken(self, name: str) -> bool:
        """See `Storage.is_taken`."""
        return self.sweep(name).folder.exists()

    def sweeps(self) -> list[SweepStore]:
        """See `Storage.sweeps`."""
        return list_sweep_stores(self._folder)

"""The local store: sweeps in folders of this machine or of a network file system. See `contract`."""

from __future__ import annotations

from pathlib import Path, PurePath

from policies.errors import NotFoundError
from policies.files import absolute
from tune_jobs.store.command_names import name_taken
from tune_jobs.store.places import parts_of
from tune_jobs.store.presence import is_link, is_there
from tune_jobs.store.sweep_store import SweepStore

_MAX_NAME_BYTES = 255


class LocalStorage:
    """A folder with one folder per sweep; implements `Storage`.

    Args:
        folder: The folder, which need not exist.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    @property
    def place(self) -> str:
        """The folder, as an absolute path."""
        return str(absolute(self._folder))

    def sweep(self, name: str) -> SweepStore:
        """Return the sweep of a name, which need not exist yet."""
        is_part = "\0" not in name and name not in ("", ".", "..") and PurePath(name).name == name
        # What a file system takes; a longer one would be an error of the system.
        if not is_part or len(name.encode(errors="surrogatepass")) > _MAX_NAME_BYTES:
            raise NotFoundError(f"{name[:80]!r} cannot be a sweep's name.", "List the sweeps with `tune-jobs list`.")
        return SweepStore(self._folder / name)

    def new_sweep(self, name: str) -> SweepStore:
        """Return a new sweep of a name that seems to be free."""
        sweep = self.sweep(name)
        if self.is_taken(name):
            raise name_taken(sweep.folder, is_sweep=sweep.exists())
        return sweep

    def is_taken(self, name: str) -> bool:
        """Whether there is anything of this name; a link to what isn't there is in the way of a folder, too.

        Raises:
            CheckpointError: The storage gives no answer.
        """
        folder = self.sweep(name).folder
        return is_link(folder) or is_there(folder)

    def sweeps(self) -> list[SweepStore]:
        """Return the sweeps in the folder, by name; none if there is no such folder.

        Raises:
            CheckpointError: The folder cannot be read.
        """
        return [store for store in map(SweepStore, sorted(parts_of(self._folder))) if store.exists()]

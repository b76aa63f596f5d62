"""Copies of other trials' checkpoints that a trial was given, as objects: see `tune_jobs.store.copies`."""

from __future__ import annotations

import secrets
import shutil
import threading
from collections.abc import Callable, Collection
from pathlib import Path
from typing import cast
from weakref import WeakMethod

from analysis.records import CheckpointRecord
from tune_jobs.store import names
from tune_jobs.store.manifests import described_files, files_of, verify_checkpoint
from tune_jobs.store.objects.bucket import Bucket
from tune_jobs.store.objects.scratch import filling
from tune_jobs.store.places import within


class CopyObjects:
    """The copies of one trial, by its own iteration at that time.

    Args:
        bucket: The sweep's objects.
        trial: What the keys of the trial's objects begin with.
        folder: Returns the local folder of the trial, in one of this process; it is of an object that has this one.
    """

    def __init__(self, bucket: Bucket, trial: str, folder: WeakMethod[Callable[[], Path]]) -> None:
        self._bucket, self._prefix, self._folder_of = bucket, f"{trial}/{names.COPIES_FOLDER}", folder
        self._lock = threading.Lock()
        self.noted: list[int] | None = None
        """Which to keep when the others are removed with the next head; None: nothing is to be removed."""

    def _folder(self) -> Path:
        # Weakly, or both would be kept, with their files, until garbage is collected.
        return cast("Callable[[], Path]", self._folder_of())()

    def prefix_of(self, iteration: int) -> str:
        """Return what the keys of a copy's objects begin with."""
        return f"{self._prefix}/{iteration:06d}"

    def iterations(self) -> list[int]:
        """Return those of all copies, and of what is left of some."""
        found, _ = self._bucket.children(self._prefix)
        return [int(name) for name in found if name.isdecimal()]

    def copy(self, folder: Path, iteration: int) -> CheckpointRecord:
        """Copy a whole checkpoint; see `Trial.copy_checkpoint`."""
        record = verify_checkpoint(folder)
        prefix = self.prefix_of(iteration)
        # Without its manifest, what is there of an earlier copy is none.
        self._bucket.delete([f"{prefix}/{names.MANIFEST}"])
        files = files_of(folder)
        manifest = files.pop(names.MANIFEST)
        for name, path in files.items():
            self._bucket.put(f"{prefix}/{name}", path)
        self._bucket.put(f"{prefix}/{names.MANIFEST}", manifest)
        return record

    def fetch(self, iteration: int) -> Path:
        """Return a local folder with a copy; it does not exist if there is no copy."""
        folder = within(self._folder(), names.COPIES_FOLDER, f"{iteration:06d}")
        prefix = self.prefix_of(iteration)
        # Elsewhere first: a copy of which some files could not be fetched is none.
        made = self._folder() / "fetched" / secrets.token_hex(8)
        if not folder.exists() and self._bucket.fetch(f"{prefix}/{names.MANIFEST}", made / names.MANIFEST):
            for name in described_files(made):
                self._bucket.fetch(f"{prefix}/{name}", made / name)
            with filling():
                folder.parent.mkdir(parents=True, exist_ok=True)
                made.rename(folder)
        return folder

    def remove(self, keep: Collection[int] = (), below: int | None = None) -> None:
        """Remove copies at once.

        Args:
            keep: The iterations of those that stay.
            below: Those of this iteration and later ones stay too; None: none but `keep`.
        """

        def goes(name: str) -> bool:
            # What has no number is part of no copy.
            number = int(name) if name.isdecimal() else None
            return number is None or (number not in keep and (below is None or number < below))

        listed = [item.key for item in self._bucket.listed(f"{self._prefix}/")]
        gone = [key for key in listed if goes(key.removeprefix(f"{self._prefix}/").partition("/")[0])]
        # The manifest first: half a copy is none.
        self._bucket.delete(sorted(gone, key=lambda key: not key.endswith(f"/{names.MANIFEST}")))
        for folder in (self._folder() / names.COPIES_FOLDER).glob("*"):
            if goes(folder.name):
                shutil.rmtree(folder, ignore_errors=True)

    def note(self, keep: Collection[int]) -> None:
        """Have the copies removed that the next head replaces; see `remove_replaced`."""
        with self._lock:
            self.noted = list(keep)

    def remove_replaced(self, noted: list[int] | None, latest: int) -> None:
        """Remove what was noted before a head was made, now that it is in the store, and so this process's to remove.

        A copy that was made at the iteration of the latest checkpoint, or later, stays: the trial goes on from it.

        Args:
            noted: What was noted by then.
            latest: The iteration of the head's latest checkpoint; 0: it has none.
        """
        if noted is None:
            return
        self.remove(noted, latest)
        with self._lock:
            # It may have been noted again, for a checkpoint that this head does not have.
            if self.noted is noted:
                self.noted = None

"""A trial's checkpoints as objects that are written once, each checkpoint's below a prefix that its head names."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from policies.errors import MALFORMED, NotFoundError
from tune_jobs.store import names
from tune_jobs.store.manifests import described_files
from tune_jobs.store.objects.at_once import side_by_side
from tune_jobs.store.objects.bucket import Bucket, Listed
from tune_jobs.store.objects.head import StoredCheckpoint


@dataclass(frozen=True)
class CheckpointObjects:
    """The objects of one trial's checkpoints."""

    bucket: Bucket
    prefix: str
    """The trial's."""
    _fetched: set[str] = field(default_factory=set)
    """The names of those that this process has fetched whole."""

    def prefix_of(self, iteration: int, key: str) -> str:
        """Return what the keys of a checkpoint's objects begin with."""
        return f"{self.prefix}/{names.CHECKPOINTS_FOLDER}/{iteration:06d}-{key}"

    def fetch(self, iteration: int, stored: StoredCheckpoint, folder: Path) -> None:
        """Fetch the files into a folder that has the manifest.

        Raises:
            StorageError: The store cannot be read.
            CannotRunError: A file cannot be written.
        """
        if stored.key in self._fetched:
            # Objects are written once.
            return
        prefix = self.prefix_of(iteration, stored.key)
        described: list[str] = []
        # Who reads the manifest is told what is wrong with it.
        with contextlib.suppress(NotFoundError):
            described = described_files(folder)
        wanted = {f"{prefix}/{name}": folder / name for name in described if not (folder / name).exists()}
        # All that is there, so that something which the manifest does not name is found out.
        listed: list[Listed] = []
        side_by_side(
            lambda key: self.bucket.fetch(key, wanted[key]) if key else listed.extend(self.bucket.listed(f"{prefix}/")),
            ["", *wanted],
        )
        for item in listed:
            name = PurePosixPath(item.key.removeprefix(f"{prefix}/"))
            if ".." not in name.parts and not (folder / name).exists():
                self.bucket.fetch(item.key, folder / name)
        if described and all((folder / name).exists() for name in described):
            self._fetched.add(stored.key)

    def upload(self, iteration: int, key: str, folder: Path) -> StoredCheckpoint | None:
        """Upload a checkpoint's files; None: it was replaced meanwhile, and files of two are none.

        Raises:
            FileNotFoundError: A file is gone.
            CheckpointError: The manifest is gone, or says nothing.
            StorageError: The store cannot be written.
        """
        manifest = (folder / names.MANIFEST).read_text(encoding="utf-8")
        prefix = self.prefix_of(iteration, key)
        self.bucket.put_all({f"{prefix}/{name}": folder / name for name in described_files(folder)})
        is_same = (folder / names.MANIFEST).read_text(encoding="utf-8") == manifest
        return StoredCheckpoint(key=key, manifest=manifest) if is_same else None

    def keys_of(self, checkpoints: Mapping[int, StoredCheckpoint], named: Collection[str]) -> list[str]:
        """Return the objects of checkpoints that are not named; one whose manifest cannot be read leaves leftovers."""
        found = []
        for iteration, stored in checkpoints.items():
            with contextlib.suppress(*MALFORMED):
                described = json.loads(stored.manifest)["files"] if stored.key not in named else ()
                found += [f"{self.prefix_of(iteration, stored.key)}/{name}" for name in described]
        return found

"""Sweeps in an object store, by name; see `contract.Storage`."""

from __future__ import annotations

from pathlib import PurePosixPath

from policies.errors import CheckpointError, NotFoundError
from tune_jobs.store.objects.at_once import side_by_side
from tune_jobs.store.objects.bucket import Bucket, StorageError
from tune_jobs.store.objects.object_sweep import ObjectSweep, name_taken
from tune_jobs.store.objects.url import ObjectUrl

_MAX_NAME_BYTES = 255


class ObjectStorage:
    """An address with sweeps below it; implements `Storage`.

    Args:
        url: The address.
    """

    def __init__(self, url: ObjectUrl) -> None:
        self._url = url

    @property
    def place(self) -> str:
        """The address."""
        return str(self._url)

    def sweep(self, name: str) -> ObjectSweep:
        """Return the sweep of a name, which need not exist yet."""
        is_part = "\0" not in name and name not in ("", ".", "..") and PurePosixPath(name).name == name
        if not is_part or len(name.encode(errors="surrogatepass")) > _MAX_NAME_BYTES:
            raise NotFoundError(f"{name[:80]!r} cannot be a sweep's name.", "List the sweeps with `tune-jobs list`.")
        return ObjectSweep(self._url.child(name))

    def new_sweep(self, name: str) -> ObjectSweep:
        """Return a new sweep of a name that seems to be free."""
        sweep = self.sweep(name)
        if sweep.is_taken():
            raise name_taken(sweep.url)
        return sweep

    def is_taken(self, name: str) -> bool:
        """Whether there is anything below this name."""
        return self.sweep(name).is_taken()

    def sweeps(self) -> list[ObjectSweep]:
        """Return the sweeps that exist, by name."""
        try:
            bucket = Bucket(self._url)
            folders, _ = bucket.children()
            if not folders:
                bucket.is_store()
            # Hidden ones are rehearsals.
            found = [self.sweep(name) for name in folders if not name.startswith(".")]
            exist = side_by_side(ObjectSweep.exists, found)
        except StorageError as error:
            raise CheckpointError(error.message, error.hint) from error
        return [sweep for sweep, is_there in zip(found, exist, strict=True) if is_there]

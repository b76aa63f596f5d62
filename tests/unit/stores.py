"""Every store there is, for the tests of what a store promises; a later one is added here.

A store's harness opens it, and reaches past it: to what is kept of a sweep, under the names that docs/design.md has.
"""

from pathlib import Path
from typing import Protocol

from tune_jobs.store.contract import Storage, Sweep
from tune_jobs.store.opening import open_storage, open_sweep


class Harness(Protocol):
    """One storage of a kind, in an empty folder of its own."""

    def storage(self) -> Storage:
        """The storage, opened anew: what another process sees."""

    def by_place(self, sweep: Sweep) -> Sweep:
        """A sweep, opened anew by its place."""

    def keys(self, sweep: str) -> set[str]:
        """What is kept of a sweep, hidden names too."""

    def content(self, sweep: str, key: str) -> bytes:
        """What is kept under a name."""

    def put(self, sweep: str, key: str, content: bytes) -> None:
        """Put something there."""

    def remove(self, sweep: str, key: str) -> None:
        """Take something away."""


class LocalHarness:
    """Folders."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "storage"

    def storage(self) -> Storage:
        return open_storage(self._folder)

    def by_place(self, sweep: Sweep) -> Sweep:
        return open_sweep(sweep.place)

    def keys(self, sweep: str) -> set[str]:
        root = self._folder / sweep
        return {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}

    def content(self, sweep: str, key: str) -> bytes:
        return (self._folder / sweep / key).read_bytes()

    def put(self, sweep: str, key: str, content: bytes) -> None:
        path = self._folder / sweep / key
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)

    def remove(self, sweep: str, key: str) -> None:
        (self._folder / sweep / key).unlink()


HARNESSES = {"local": LocalHarness}
"""By name; each takes an empty folder."""

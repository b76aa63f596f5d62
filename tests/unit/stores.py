"""Every store there is, for the tests of what a store promises; a later one is added here.

A store's harness opens it, and reaches past it: to what is kept of a sweep, under the names that docs/design.md has.
"""

import contextlib
import os
import re
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import pytest
from s3_server import s3_endpoint

from policies.errors import TuneJobsError
from tune_jobs.store.contract import Storage, Sweep
from tune_jobs.store.objects.bucket import Bucket
from tune_jobs.store.objects.head import Chunk, Head, read_head
from tune_jobs.store.objects.object_storage import ObjectStorage
from tune_jobs.store.objects.outbox import outbox
from tune_jobs.store.objects.url import ObjectUrl
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

    def shown(self, key: str) -> str:
        """How messages name what is kept under a name."""


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

    def shown(self, key: str) -> str:
        return key


class ObjectHarness:
    """Objects of an S3 server on this machine; a reader comes when what was written is uploaded."""

    def __init__(self, folder: Path) -> None:
        path = f"{folder.name}-{secrets.token_hex(4)}"
        self._url = ObjectUrl.parse(self._address(path))

    @staticmethod
    def _address(path: str) -> str:
        return f"s3://sweeps/{path}?endpoint={s3_endpoint()}"

    def storage(self) -> Storage:
        self._settle()
        return ObjectStorage(self._url)

    def by_place(self, sweep: Sweep) -> Sweep:
        return open_sweep(sweep.place)

    def keys(self, sweep: str) -> set[str]:
        self._settle()
        return {item.key for item in self._bucket(sweep).listed()}

    def content(self, sweep: str, key: str) -> bytes:
        self._settle()
        bucket, trial, part = self._bucket(sweep), *self._in_trial(key)
        head = self._head(sweep, trial)
        if part == "results.jsonl":
            return b"".join(self._got(bucket, f"{trial}/results/{chunk.key}.jsonl") for chunk in head.results)
        if part.startswith("damaged/results.jsonl"):
            keys = head.damaged[part.removeprefix("damaged/")].split()
            return b"".join(self._got(bucket, f"{trial}/results/{key}.jsonl") for key in keys)
        if found := re.fullmatch(r"checkpoints/(\d+)/manifest\.json", part):
            return head.checkpoints[int(found[1])].manifest.encode()
        return self._got(bucket, self._key(sweep, key))

    def put(self, sweep: str, key: str, content: bytes) -> None:
        self._settle()
        bucket, trial, part = self._bucket(sweep), *self._in_trial(key)
        if part == "results.jsonl":
            chunk = Chunk(key=secrets.token_hex(8), num_bytes=len(content))
            bucket.put(f"{trial}/results/{chunk.key}.jsonl", content)
            self._write_head(sweep, trial, results=(chunk,), has_results=True)
        elif found := re.fullmatch(r"checkpoints/(\d+)/manifest\.json", part):
            known = dict(self._head(sweep, trial).checkpoints)
            changes = {"manifest": content.decode()}
            known[int(found[1])] = known[int(found[1])].model_copy(update=changes)
            self._write_head(sweep, trial, checkpoints=known)
        else:
            bucket.put(self._key(sweep, key), content)

    def remove(self, sweep: str, key: str) -> None:
        self._settle()
        trial, part = self._in_trial(key)
        if part == "results.jsonl":
            self._write_head(sweep, trial, results=(), has_results=False)
        elif part.endswith("/manifest.json"):
            self.put(sweep, key, b"")
        else:
            self._bucket(sweep).delete([self._key(sweep, key)])

    def _key(self, sweep: str, key: str) -> str:
        """Where an object store has what a folder has as this file."""
        trial, part = self._in_trial(key)
        if found := re.fullmatch(r"(checkpoints|damaged)/(\d+[-\d]*)/(.+)", part):
            head = self._head(sweep, trial)
            number = found[2].partition("-")[0]
            name = head.checkpoints[int(number)].key if found[1] == "checkpoints" else head.damaged[found[2]]
            return f"{trial}/checkpoints/{number}-{name}/{found[3]}"
        return _shown(key)

    @staticmethod
    def _in_trial(key: str) -> tuple[str, str]:
        found = re.fullmatch(r"(trials/t\d+)/(.+)", key)
        return (found[1], found[2]) if found is not None else ("", key)

    def _head(self, sweep: str, trial: str) -> Head:
        return read_head(self._bucket(sweep), f"{trial}/head.json")[0]

    def _write_head(self, sweep: str, trial: str, **changes: object) -> None:
        head = self._head(sweep, trial)
        data = head.model_copy(update={**changes, "sequence": head.sequence + 1}).model_dump_json().encode()
        self._bucket(sweep).put(f"{trial}/head.json", data)

    def _bucket(self, sweep: str) -> Bucket:
        return Bucket(self._url.child(sweep))

    @staticmethod
    def _got(bucket: Bucket, key: str) -> bytes:
        found = bucket.get(key)
        if found is None:
            raise FileNotFoundError(key)
        return found.data

    @staticmethod
    def _settle() -> None:
        # What cannot be uploaded, being of an owner before, is a matter of other calls.
        with contextlib.suppress(TuneJobsError):
            outbox().settle()

    def shown(self, key: str) -> str:
        return _shown(key)


@pytest.fixture(name="harness")
def object_harness(tmp_path: Path) -> ObjectHarness:
    """In the place of the one that is each kind of store, for tests of objects alone."""
    return ObjectHarness(tmp_path)


class RunningHarness(ObjectHarness):
    """Objects of a server that somebody has started, in a container of its own: Azurite, or a real store."""

    @staticmethod
    def _address(path: str) -> str:
        place, mark, settings = os.environ[STORAGE_VARIABLE].partition("?")
        return f"{place}/{path}{mark}{settings}"


def _shown(key: str) -> str:
    """Where an object store has a record."""
    found = re.fullmatch(r"trials/(t\d+)/trial\.json", key)
    return f"records/{found[1]}.json" if found is not None else key


STORAGE_VARIABLE = "TUNE_JOBS_TEST_STORAGE"
"""Names the address, such as `az://container?endpoint=...`, of a store that runs, for one more harness."""

HARNESSES: dict[str, Callable[[Path], Harness]] = {
    "local": LocalHarness,
    "s3": ObjectHarness,
    **({"running": RunningHarness} if STORAGE_VARIABLE in os.environ else {}),
}
"""By name; each takes an empty folder."""

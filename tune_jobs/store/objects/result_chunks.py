"""A trial's results as objects that are written once: each holds some lines, and the head says in which order."""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tune_jobs.store.objects.bucket import Bucket
from tune_jobs.store.objects.head import Chunk
from tune_jobs.store.objects.scratch import write_local

_SMALL_BYTES = 2**18
"""A last chunk that is smaller is written anew, with what is new."""


@dataclass(frozen=True)
class ResultChunks:
    """The chunks of one trial, with local copies."""

    bucket: Bucket
    prefix: str
    """The trial's."""
    folder: Path
    """Where the copies are, by their keys."""

    def read(self, chunks: Sequence[Chunk]) -> bytes | None:
        """Return the results; None: a chunk does not exist any more.

        Raises:
            StorageError: The store cannot be read.
        """
        content = []
        for chunk in chunks:
            path = self.folder / chunk.key
            if not path.exists() and not self.bucket.fetch(self._object(chunk.key), path):
                return None
            content.append(path.read_bytes())
        return b"".join(content)

    def upload(self, content: bytes, known: Sequence[Chunk]) -> tuple[Chunk, ...]:
        """Upload what is new of the results, and return all their chunks.

        Args:
            content: The results.
            known: The chunks that the store has; those that still begin the results are kept.

        Raises:
            StorageError: The store cannot be written.
        """
        kept: list[Chunk] = []
        offset = 0
        for chunk in known:
            path = self.folder / chunk.key
            if not path.exists() or content[offset : offset + chunk.num_bytes] != path.read_bytes():
                break
            kept.append(chunk)
            offset += chunk.num_bytes
        if offset == len(content):
            return tuple(kept)
        if kept and kept[-1].num_bytes < _SMALL_BYTES:
            offset -= kept.pop().num_bytes
        new = Chunk(key=secrets.token_hex(8), num_bytes=len(content) - offset)
        self.bucket.put(self._object(new.key), content[offset:])
        write_local(self.folder / new.key, content[offset:])
        return (*kept, new)

    def forget(self, keys: Iterable[str]) -> list[str]:
        """Remove the copies of chunks that no head names, and return their objects, which the caller removes."""
        gone = list(keys)
        for key in gone:
            (self.folder / key).unlink(missing_ok=True)
        return [self._object(key) for key in gone]

    def _object(self, key: str) -> str:
        return f"{self.prefix}/results/{key}.jsonl"

"""A trial's results as objects that are written once: each holds some lines, and the head says in which order.

A chunk never changes, so what is known to be in the local file stays so: of a long trial only the end is read, written
and uploaded.
"""

from __future__ import annotations

import itertools
import os
import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tune_jobs.store.objects.bucket import Bucket
from tune_jobs.store.objects.head import Chunk
from tune_jobs.store.objects.scratch import grow_local, write_local

_SMALL_BYTES = 2**18
"""A last chunk that is smaller is written anew, with what is new."""


@dataclass(frozen=True)
class NewChunk:
    """A chunk that the store lacks."""

    chunk: Chunk
    content: bytes


class ResultChunks:
    """The chunks of one trial, with local copies, and what of them the local file with its results has.

    Args:
        bucket: The sweep's objects.
        prefix: The trial's.
    """

    def __init__(self, bucket: Bucket, prefix: str) -> None:
        self._bucket, self._prefix = bucket, prefix
        self._begun: tuple[Chunk, ...] = ()
        """What the local file begins with."""

    def forget_file(self) -> None:
        """Forget what the local file has, before it is written in another way than here or by lines at its end."""
        self._begun = ()

    def read(self, chunks: Sequence[Chunk], path: Path) -> bool:
        """Bring the local file to the results; return False if a chunk does not exist any more.

        Args:
            chunks: All chunks, in their order.
            path: The local file; who has it open sees what is new, where it only grows.

        Raises:
            StorageError: The store cannot be read.
            CannotRunError: The file cannot be written.
        """
        num_known, offset = self._known(chunks, path)
        content = []
        for chunk in chunks[num_known:]:
            copy = self._copy(chunk.key, path)
            if not copy.exists() and not self._bucket.fetch(self._object(chunk.key), copy):
                return False
            content.append(copy.read_bytes())
        self.forget_file()
        grow_local(path, b"".join(content), offset)
        if path.stat().st_size == _size(chunks):
            self._begun = tuple(chunks)
        return True

    def divide(self, path: Path, known: Sequence[Chunk]) -> tuple[tuple[Chunk, ...], NewChunk | None]:
        """Return all chunks of the results in the local file, and the last one if it is new.

        Nothing may be written to the file meanwhile, unless at its end.

        Args:
            path: The local file.
            known: The chunks that the store has; those that still begin the results are kept.
        """
        num_known, offset = self._known(known, path)
        kept = list(known[:num_known])
        with path.open("rb") as file:
            file.seek(offset)
            for chunk in known[num_known:]:
                copy = self._copy(chunk.key, path)
                if not copy.exists() or file.read(chunk.num_bytes) != copy.read_bytes():
                    break
                kept.append(chunk)
            offset = _size(kept)
            if offset < file.seek(0, os.SEEK_END) and kept and kept[-1].num_bytes < _SMALL_BYTES:
                offset -= kept.pop().num_bytes
            file.seek(offset)
            content = file.read()
        new = NewChunk(Chunk(key=secrets.token_hex(8), num_bytes=len(content)), content) if content else None
        self._begun = (*kept, new.chunk) if new is not None else tuple(kept)
        return self._begun, new

    def upload(self, new: NewChunk, path: Path) -> None:
        """Upload a new chunk; `path` is the local file that it is of.

        Raises:
            StorageError: The store cannot be written.
        """
        self._bucket.put(self._object(new.chunk.key), new.content)
        write_local(self._copy(new.chunk.key, path), new.content)

    def forget(self, keys: Iterable[str], path: Path) -> list[str]:
        """Remove the copies of chunks that no head names, and return their objects, which the caller removes."""
        gone = list(keys)
        for key in gone:
            self._copy(key, path).unlink(missing_ok=True)
        return [self._object(key) for key in gone]

    def _known(self, chunks: Sequence[Chunk], path: Path) -> tuple[int, int]:
        """Return how many chunks the local file begins with, as far as that is known, and how many bytes these are."""
        same = itertools.takewhile(lambda pair: pair[0] == pair[1], zip(self._begun, chunks, strict=False))
        known = [chunk for chunk, _ in same]
        offset = _size(known)
        # Gone with its folder, say.
        is_there = path.exists() and path.stat().st_size >= offset
        return (len(known), offset) if is_there else (0, 0)

    @staticmethod
    def _copy(key: str, path: Path) -> Path:
        return path.parent / "chunks" / key

    def _object(self, key: str) -> str:
        return f"{self._prefix}/results/{key}.jsonl"


def _size(chunks: Iterable[Chunk]) -> int:
    return sum(chunk.num_bytes for chunk in chunks)

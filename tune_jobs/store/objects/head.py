"""The head of a trial: one small object that says who owns the trial and which objects are its state.

Objects with results and checkpoints are written once, under names of their own, and count from the moment that the head
names them. The head is replaced only by who knows its present content. So a state is there whole or not at all, and an
earlier owner can change nothing.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Container, Iterable, Mapping

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from analysis.records import FORMAT_VERSION
from policies.errors import UPGRADE, CheckpointError
from policies.wrong_values import details_of, dotted, explain
from tune_jobs.store import names
from tune_jobs.store.objects.bucket import Bucket, Found, Tag

NAMED = ("results", names.CHECKPOINTS_FOLDER)
"""The folders of a trial whose objects its head names."""
_KEY = r"^[0-9a-f]{16}$"


class Chunk(BaseModel):
    """A part of a trial's results."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    key: str = Field(pattern=_KEY)
    num_bytes: int = Field(ge=0)


class StoredCheckpoint(BaseModel):
    """A checkpoint: its manifest, and the name that its files are under."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    key: str = Field(pattern=_KEY)
    manifest: str


class Head(BaseModel):
    """What a trial's state is."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    format_version: int = FORMAT_VERSION
    owner: str = ""
    """The owner's token."""
    sequence: int = Field(0, ge=0)
    """How often the head was written."""
    has_results: bool = False
    results: tuple[Chunk, ...] = ()
    checkpoints: Mapping[int, StoredCheckpoint] = Field(default_factory=dict)
    """By iteration."""
    damaged: Mapping[str, str] = Field(default_factory=dict)
    """What was set aside: its name, and the name that its files are under."""

    def named(self) -> set[str]:
        """Return the names of all objects that it names."""
        damaged = {key for text in self.damaged.values() for key in text.split()}
        return damaged | {chunk.key for chunk in self.results} | {item.key for item in self.checkpoints.values()}


def free(name: str, taken: Container[str]) -> str:
    """Return a name, with a number if it is taken."""
    numbered = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
    return next(free for free in numbered if free not in taken)


def unnamed(prefix: str, present: Iterable[str], named: Collection[str]) -> list[str]:
    """Return those of a trial's results and checkpoints that are not among those named.

    Args:
        prefix: What the keys of the trial's objects begin with.
        present: Keys of the trial's objects, of any kind.
        named: What is named.
    """
    gone = []
    for key in present:
        folder, _, rest = key.removeprefix(f"{prefix}/").partition("/")
        part = rest.partition("/")[0].removesuffix(".jsonl").rpartition("-")[2]
        if folder in NAMED and part not in named:
            gone.append(key)
    return gone


def read_head(bucket: Bucket, key: str) -> tuple[Head, Tag | None]:
    """Read a head; a trial without one has an empty state.

    Returns:
        The head, and what its content is known by; None: there is none.

    Raises:
        CheckpointError: It is damaged or of a newer format.
        StorageError: It cannot be read.
    """
    found = bucket.get(key)
    return (Head(), None) if found is None else (_parsed(found, bucket.name_of(key)), found.tag)


def _parsed(found: Found, name: str) -> Head:
    try:
        head = Head.model_validate_json(found.data)
    except ValidationError as error:
        first = details_of(error)[0]
        raise CheckpointError(
            f"{name} is not a valid head of a trial: {dotted(first['loc'])} {explain(first)}.".replace(":  ", ": "),
            "Restore an earlier version of the object, or delete it: the trial then begins anew.",
        ) from error
    if head.format_version > FORMAT_VERSION:
        raise CheckpointError(
            f"{name} has format version {head.format_version}; this tune-jobs reads up to {FORMAT_VERSION}.",
            UPGRADE,
        )
    if any(iteration < 0 or iteration >= 10**18 for iteration in head.checkpoints):
        raise CheckpointError(
            f"{name} names a checkpoint of no iteration.", "Restore an earlier version of the object."
        )
    return head

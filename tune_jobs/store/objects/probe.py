"""Find out whether another machine reaches the same storage and may do there all that a sweep needs."""

from __future__ import annotations

import contextlib
import secrets
from collections.abc import Iterator

from tune_jobs.store.objects.bucket import Bucket, ConflictError, StorageError
from tune_jobs.store.objects.url import ObjectUrl

_FOLDER, _QUESTION = "probe", "question"


class ObjectProbe:
    """A question in a sweep's objects; see `tune_jobs.store.probe.Probe`.

    Args:
        bucket: The sweep's objects.
        token: The question, a random text.
    """

    def __init__(self, bucket: Bucket, token: str) -> None:
        self._bucket, self._token = bucket, token

    @property
    def place(self) -> str:
        """The text that a machine has to pass to `answer`."""
        return str(self._bucket.url)

    def is_same(self, question: str, machine: str) -> bool:
        """Whether a machine has read this question, and its answer can be seen here."""
        try:
            found = self._bucket.get(f"{_FOLDER}/{machine}")
        except StorageError:
            return False
        return found is not None and question == self._token == found.data.decode(errors="replace")


@contextlib.contextmanager
def probing(bucket: Bucket) -> Iterator[ObjectProbe]:
    """Ask a question, and remove it with its answers after the block.

    Raises:
        CannotRunError: The store cannot be written.
    """
    token = secrets.token_hex(8)
    bucket.put(f"{_FOLDER}/{_QUESTION}", token.encode())
    try:
        yield ObjectProbe(bucket, token)
    finally:
        with contextlib.suppress(StorageError):
            bucket.delete([item.key for item in bucket.listed(f"{_FOLDER}/")])


def answer(place: str, machine: str) -> str:
    """Read the question on another machine, leave an answer, and try what a sweep does there.

    Args:
        place: The probe's place.
        machine: A name of this machine.

    Raises:
        StorageError: Something cannot be done from here; the message names it.
    """
    bucket = Bucket(ObjectUrl.parse(place))
    found = bucket.get(f"{_FOLDER}/{_QUESTION}")
    if found is None:
        raise StorageError(
            f"{bucket.name_of(_FOLDER)} is not seen from here.",
            "Check that the storage's address, with its endpoint, means the same on every machine.",
        )
    mine = f"{_FOLDER}/try-{machine}"
    tag = bucket.put(mine, b"1", is_new=True)
    _refuses(bucket, mine, "If-None-Match", over=None)
    bucket.put(mine, b"2", over=tag)
    _refuses(bucket, mine, "If-Match", over=tag)
    if mine not in {item.key for item in bucket.listed(f"{_FOLDER}/")}:
        raise StorageError(
            f"{bucket.name_of(_FOLDER)} is listed without what was just written there.",
            "Choose a store whose listings are consistent.",
        )
    bucket.delete([mine])
    bucket.put(f"{_FOLDER}/{machine}", found.data)
    return found.data.decode(errors="replace")


def _refuses(bucket: Bucket, key: str, condition: str, over: tuple[str | None, str | None] | None) -> None:
    """Check that the store keeps to a condition: a sweep is safe from two writers by them alone."""
    try:
        bucket.put(key, secrets.token_bytes(8), over=over, is_new=over is None)
    except ConflictError:
        return
    raise StorageError(
        f"{bucket.url.short} writes although a condition ({condition}) forbids it.",
        "Choose a store with conditional writes: S3, GCS, Azure, or MinIO, SeaweedFS and Ceph of this year.",
    )

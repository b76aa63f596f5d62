"""Find out whether another machine reaches the same storage and may do there all that a sweep needs."""

from __future__ import annotations

import contextlib
import secrets
from collections.abc import Iterator

from tune_jobs.store.objects.bucket import Bucket, ConflictError, StorageError, Tag
from tune_jobs.store.objects.url import ObjectUrl
from tune_jobs.store.probe import FailedOperationError, Operation

FOLDER = "probe"
"""What the keys of a question and its answers begin with."""
_QUESTION = "question"


class ObjectProbe:
    """A question in a sweep's objects; implements `Probe`.

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
            found = self._bucket.get(f"{FOLDER}/{machine}")
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
    bucket.put(f"{FOLDER}/{_QUESTION}", token.encode())
    try:
        yield ObjectProbe(bucket, token)
    finally:
        with contextlib.suppress(StorageError):
            bucket.delete([item.key for item in bucket.listed(f"{FOLDER}/")])


def answer(place: str, machine: str) -> str:
    """Read the question on another machine, leave an answer, and try what trials do there.

    Args:
        place: The probe's place.
        machine: A name of this machine.

    Raises:
        FileNotFoundError: Another store, or another place in it, is seen here.
        FailedOperationError: An operation fails here, or does not do what it says.
    """
    bucket = Bucket(ObjectUrl.parse(place))
    mine = f"{FOLDER}/{machine}.try"
    with _trying("read"):
        found = bucket.get(f"{FOLDER}/{_QUESTION}")
    if found is None:
        raise FileNotFoundError(bucket.name_of(FOLDER))
    with _trying("write"):
        tag = bucket.put(mine, b"1")
        bucket.put(f"{FOLDER}/{machine}", found.data)
    with _trying("list"):
        listed = {item.key for item in bucket.listed(f"{FOLDER}/")}
        if not {mine, f"{FOLDER}/{machine}"} <= listed:
            raise FailedOperationError("list", "objects that are there are not listed")
    with _trying("lock"):
        bucket.put(mine, b"2", over=tag)
        # A sweep is safe from two writers by these conditions alone.
        _refuses(bucket, mine, "If-Match", over=tag)
        _refuses(bucket, mine, "If-None-Match", over=None)
    with _trying("delete"):
        bucket.delete([mine])
        if bucket.look(mine) is not None:
            raise FailedOperationError("delete", "an object that was deleted is still there")
    return found.data.decode(errors="replace")


@contextlib.contextmanager
def _trying(operation: Operation) -> Iterator[None]:
    try:
        yield
    except StorageError as error:
        raise FailedOperationError(operation, error.message.rstrip(".")) from error


def _refuses(bucket: Bucket, key: str, condition: str, over: Tag | None) -> None:
    """Check that the store keeps to a condition of writes."""
    try:
        bucket.put(key, secrets.token_bytes(8), over=over, is_new=over is None)
    except ConflictError:
        return
    raise FailedOperationError("lock", f"the store writes although a condition ({condition}) forbids it")

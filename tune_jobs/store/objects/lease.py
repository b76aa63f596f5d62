"""A lock between processes anywhere, made of an object: its holder writes there every few seconds that it lives.

Nobody's clock is compared with another's: who wants the lock watches, by its own clock, whether the holder still
writes. A holder of this machine whose process has ended is not waited for. The lock keeps two processes from driving
one sweep; that a holder which was cut off writes nothing afterwards does not depend on it, see `owners`.
"""

from __future__ import annotations

import contextlib
import json
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from policies.errors import CannotRunError
from policies.parents import is_gone, this_process
from tune_jobs.process.clock import passing_s
from tune_jobs.store.objects.bucket import Bucket, ConflictError, Found, StorageError, Tag

_BEAT_S = 4.0
"""Seconds between two signs of life."""
LEASE_S = 30.0
"""Seconds without one after which a holder counts as gone. A request to the store may take some of them."""
_FREE = b"{}"


@contextlib.contextmanager
def leased(bucket: Bucket, key: str, message: str, hint: str, *, is_first: bool = False) -> Iterator[Beating]:
    """Hold the lock in the block, or raise; it takes up to half a minute to find out that a holder elsewhere is gone.

    The block gets what says whether the lock is still this process's.

    Args:
        bucket: The sweep's objects.
        key: The lock's object.
        message: The error's message if another process holds it.
        hint: The error's hint if another process holds it.
        is_first: Whether nobody seems to have held it ever; the block is told whether that is so.

    Raises:
        CannotRunError: Another process holds it, or the store cannot be written.
    """
    own = secrets.token_hex(8)
    taken = _take_first(bucket, key, own) if is_first else None
    beating = Beating(bucket, key, own, *(taken or _take(bucket, key, own, message, hint)))
    beating.is_first = taken is not None
    try:
        yield beating
    finally:
        beating.end()


@dataclass(frozen=True)
class _Sighting:
    """What this process has read of a lock last."""

    data: bytes
    since: float
    """When it was read first, by `time.monotonic`."""
    has_changed: bool
    """Whether it was another before, so that its holder lived then."""


_sightings: dict[tuple[str, str], _Sighting] = {}


def _sighted(bucket: Bucket, key: str, data: bytes) -> _Sighting:
    where, now = (str(bucket.url), key), time.monotonic()
    known = _sightings.get(where)
    if known is None or known.data != data:
        known = _sightings[where] = _Sighting(data, now, known is not None)
    return known


def is_leased(bucket: Bucket, key: str, watch_s: float = 2.5 * _BEAT_S, believed_s: float = 2.5 * _BEAT_S) -> bool:
    """Whether a process holds the lock; for a holder elsewhere that may be gone, this takes some seconds, once.

    Args:
        bucket: The sweep's objects.
        key: The lock's object.
        watch_s: Seconds for which a holder elsewhere is watched. Only `LEASE_S` makes sure that it is gone, as its
            requests may be slow; two signs of life and a half are enough to show whether it lives. The time since
            this process has seen the same before counts.
        believed_s: Seconds after a sign of life in which a holder elsewhere is not watched for the next one.

    Raises:
        CannotRunError: The store cannot be read.
    """
    found = bucket.get(key)
    if found is None or not _holder(found):
        _sightings.pop((str(bucket.url), key), None)
        return False
    state = _is_here(_holder(found))
    if state is not None:
        return state
    seen = _sighted(bucket, key, found.data)
    if seen.has_changed and time.monotonic() - seen.since < believed_s:
        return True
    while time.monotonic() < seen.since + watch_s:
        time.sleep(0.5)
        now = bucket.get(key)
        if now is None or not _holder(now):
            return False
        if now.data != found.data:
            _sighted(bucket, key, now.data)
            return True
    return False


def _take_first(bucket: Bucket, key: str, own: str) -> tuple[Tag, float] | None:
    begun_at = _now()
    try:
        return bucket.put(key, _sign(own, 0), is_new=True), begun_at
    except ConflictError:
        return None


def _take(bucket: Bucket, key: str, own: str, message: str, hint: str) -> tuple[Tag, float]:
    seen: bytes | None = None
    since = time.monotonic()
    while True:
        found = bucket.get(key)
        holder = _holder(found) if found is not None else {}
        if holder:
            is_here = _is_here(holder)
            data = found.data if found is not None else b""
            if is_here or (seen is not None and data != seen):
                raise CannotRunError(message, hint)
            if is_here is None:
                seen = data
                if time.monotonic() - since < LEASE_S:
                    time.sleep(0.5)
                    continue
        try:
            begun_at = _now()
            if found is None:
                return bucket.put(key, _sign(own, 0), is_new=True), begun_at
            return bucket.put(key, _sign(own, 0), over=found.tag), begun_at
        except ConflictError:
            # Somebody else took it, or let it go; a new holder counts as one that lives.
            seen = seen if seen is not None else b""
            since = time.monotonic()


def _sign(key: str, beat: int) -> bytes:
    """Return what a holder writes; `key` is its own, so that it knows a write whose answer was lost."""
    sign = {"key": key, "beat": beat, "process": this_process(), "host": socket.gethostname()}
    return json.dumps({"holder": sign}).encode()


def _holder(found: Found) -> dict[str, Any]:
    try:
        holder = json.loads(found.data)["holder"]
    except (ValueError, LookupError, TypeError):
        return {}
    return holder if isinstance(holder, dict) else {}


def _is_here(holder: dict[str, Any]) -> bool | None:
    """Whether a holder of this machine lives; None: it is another machine's, or its process can't be seen from here."""
    process = holder.get("process")
    ours = this_process().rsplit(" ", 2)[0]
    if not isinstance(process, str) or not ours or process.rsplit(" ", 2)[0] != ours:
        return None
    return not is_gone(process)


def _now() -> float:
    """Return seconds that go on while the machine sleeps, as they do for who watches it."""
    return passing_s()


class Beating:
    """Writes signs of life in a thread of its own, until the end.

    Args:
        bucket: The sweep's objects.
        key: The lock's object.
        own: The holder's own word in its signs.
        tag: The content of its first sign.
        signed_at: When it began to write that, by `_now`.
    """

    def __init__(self, bucket: Bucket, key: str, own: str, tag: Tag, signed_at: float) -> None:
        self._bucket, self._key, self._tag, self._own = bucket, key, tag, own
        self._signed_at = signed_at
        self.is_first = False
        """Whether nobody has held the lock before."""
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="lease", daemon=True)
        self._thread.start()

    def _beat(self) -> None:
        beat = 0
        while not self._over.wait(_BEAT_S):
            beat += 1
            try:
                begun_at = _now()
                self._tag = self._bucket.put(self._key, _sign(self._own, beat), over=self._tag)
                self._signed_at = begun_at
            except ConflictError:
                if not self.is_ours():
                    # Another process took it for gone. It has taken the run too, so this one's writes are refused.
                    self._signed_at = -float("inf")
                    return
            except StorageError:
                # The store is away; it may be back for the next one.
                continue

    def is_sure(self) -> bool:
        """Whether nobody can have taken the lock: who wants it has not watched the latest sign for long enough."""
        return not self._over.is_set() and _now() - self._signed_at < LEASE_S / 2

    def is_ours(self) -> bool:
        """Whether the sign that is there is one of this holder's, whose writing had seemed to fail."""
        with contextlib.suppress(StorageError):
            found = self._bucket.get(self._key)
            if found is None or _holder(found).get("key") != self._own:
                return False
            self._tag = found.tag
        return True

    def end(self) -> None:
        """Let the lock go."""
        self._over.set()
        self._thread.join()
        with contextlib.suppress(StorageError):
            try:
                self._bucket.put(self._key, _FREE, over=self._tag)
            except ConflictError:
                # A sign that had seemed to fail, perhaps.
                if self.is_ours():
                    self._bucket.put(self._key, _FREE, over=self._tag)

"""Decide who may write, without locks: an owner's number is in an object that is replaced by who knows its content.

Who takes something writes a larger number there. Where a number stands beside what it guards (a trial's head), a write
of an earlier owner is refused by the store itself, as it would have to replace a content that is no more. Elsewhere
(the records of trials), a writer has to name the content that it replaces; if there is another one, it looks whether it
is still the owner. So an earlier owner can at most write what nobody has written over since.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Self

from policies.errors import CannotRunError
from tune_jobs.store.objects.at_once import side_by_side
from tune_jobs.store.objects.bucket import Bucket, ConflictError, Found, StorageError
from tune_jobs.store.objects.held import held
from tune_jobs.store.ownership import OwnershipLostError
from tune_jobs.store.trial_contract import Ownership

RUN = "run.json"
"""The object with the owner of a sweep's run; only who holds the sweep's lock takes it."""
_LOOK_EVERY_S = 1.0
"""Seconds after which the store is asked again who the owner is; its answer before that is believed."""
_BELIEVED = 3
"""How many times as long the answer before is believed while that is asked, so that who writes often never waits."""
_TOKEN = re.compile(r"(\d{1,15})\.(\d{1,15}) ([0-9a-f]{16}) (\S+) (.*)")
_ATTEMPTS = 20


@dataclass(frozen=True)
class Epoch:
    """When something was taken: in which run of the sweep, and which take it was since the sweep began."""

    run: int = 0
    number: int = 0

    @classmethod
    def of(cls, token: str) -> Self:
        """Read the epoch of a token; that of a text that is none is the first."""
        found = _TOKEN.fullmatch(token)
        return cls(int(found[1]), int(found[2])) if found is not None else cls()

    def next(self, under: str | None, what: str) -> Epoch:
        """Return the epoch of who takes something that has this one.

        Args:
            under: The token of the run, or of the pack, that it is taken for; None: for none.
            what: What is taken, for the message.

        Raises:
            OwnershipLostError: It was taken in a later run.
        """
        run = self.run if under is None else Epoch.of(under).run
        if run < self.run:
            raise lost(what)
        return Epoch(run, self.number + 1)

    def token(self) -> str:
        """Return a new owner's token."""
        host = socket.gethostname().encode("ascii", "replace").decode()
        return f"{self.run}.{self.number} {secrets.token_hex(8)} {os.getpid()} {host}"


def lost(what: str, token: str = "") -> OwnershipLostError:
    """Return the error of a process that has lost something to another one."""
    found = _TOKEN.fullmatch(token)
    by = f" ({found[4]} {found[5]})" if found is not None else ""
    return OwnershipLostError(
        f"{what} has been taken over by another process{by}.",
        "Leave it to that process; this one writes nothing there any more.",
    )


class ObjectOwner:
    """The ownership of a sweep's run or of a pack, which this process or the one that passed the token on has taken.

    Args:
        bucket: The sweep's objects.
        key: The object with the owner's token.
        token: The token.
    """

    def __init__(self, bucket: Bucket, key: str, token: str) -> None:
        self._bucket, self._key = bucket, key
        self.token = token
        self._lock = threading.RLock()
        self._looked_at, self._was_current = -float("inf"), True
        self._looking: threading.Thread | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._bucket, self._key, self.token)

    @classmethod
    def take(cls, bucket: Bucket, key: str, under: Ownership | None = None, *, is_run: bool = True) -> Self:
        """Become the owner; the owner before has lost it.

        Args:
            bucket: The sweep's objects.
            key: The object with the owner's token.
            under: The ownership of the run that this is done for; None: this is done for none.
            is_run: Whether it is a run of the sweep itself.

        Raises:
            OwnershipLostError: Another process has taken `under`, or has taken this in a later run.
            CannotRunError: It cannot be written.
        """
        # Who holds the sweep's lock knows the run's owner: it has taken the run itself, or nobody ever has.
        ours = held(bucket.url) if key == RUN else None
        for attempt in range(_ATTEMPTS):
            found = ours.found(key) if ours is not None and not attempt else None
            asked: list[Callable[[], Found | None]] = []
            if found is None and (ours is None or not ours.is_absent(key)):
                asked.append(lambda: bucket.get(key))
            if under is not None:
                asked.append(under.check)
            # Who has taken `under` since has replaced this by then, or is refused itself.
            answers = side_by_side(lambda ask: ask(), asked)
            found = found or (answers[0] if answers else None)
            before = Epoch.of(_token_in(found.data) if found is not None else "")
            if is_run:
                epoch = Epoch(before.run + 1)
            else:
                epoch = before.next(under.token if under is not None else None, bucket.name_of(key))
            token = epoch.token()
            data = json.dumps({"owner": token}).encode()
            over = None if found is None else found.tag
            try:
                if ours is None:
                    bucket.put(key, data, over=over, is_new=over is None)
                else:
                    with ours.writing(key, data) as write:
                        write.tag = bucket.put(key, data, over=over, is_new=over is None)
            except ConflictError:
                continue
            return cls(bucket, key, token)
        raise CannotRunError(
            f"{bucket.name_of(key)} is taken by one process after the other.", "End those that drive this sweep."
        )

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Check that this is the owner; writes in the block are refused by themselves if it is not any more.

        Raises:
            OwnershipLostError: Another process has become the owner.
            CannotRunError: This cannot be found out.
        """
        if not self._is_current():
            raise lost(self._bucket.name_of(self._key), self._present())
        yield

    def is_current(self) -> bool:
        """Whether no other process has become the owner, as was seen within the last three seconds.

        Raises:
            OSError: It cannot be read just now.
        """
        try:
            return self._is_current()
        except StorageError as error:
            raise OSError(error.message) from error

    def check(self) -> None:
        """Raise an error if another process has become the owner, by what the store says now.

        Raises:
            OwnershipLostError: Another process has.
        """
        # Not under the lock: who checks side by side waits for one answer, not for one after the other.
        if self._was_current:
            self._look()
        if not self._was_current:
            raise lost(self._bucket.name_of(self._key), self._present())

    def release(self) -> None:
        """Do nothing: nothing is open."""

    def _is_current(self) -> bool:
        with self._lock:
            age = time.monotonic() - self._looked_at
            # Who has lost it never has it again.
            if self._was_current and age > _BELIEVED * _LOOK_EVERY_S and not self._is_held():
                self._look()
            elif self._was_current and age > _LOOK_EVERY_S and not (self._looking and self._looking.is_alive()):
                self._looking = threading.Thread(target=self._look_again, name="owner", daemon=True)
                self._looking.start()
            return self._was_current

    def _is_held(self) -> bool:
        # Nobody else takes the run as long as this process has the sweep's lock; it is asked for without waiting.
        known = held(self._bucket.url) if self._key == RUN else None
        return known is not None and known.is_known

    def _look(self) -> None:
        asked_at = time.monotonic()
        is_current = self._present() == self.token
        with self._lock:
            self._was_current = self._was_current and is_current
            self._looked_at = max(asked_at, self._looked_at)

    def _look_again(self) -> None:
        # A store that does not answer is asked by who needs to know, once the answer before is not believed any more.
        with contextlib.suppress(StorageError):
            self._look()

    def _present(self) -> str:
        found = self._bucket.get(self._key)
        return _token_in(found.data) if found is not None else ""


def _token_in(data: bytes) -> str:
    try:
        token = json.loads(data)["owner"]
    except (ValueError, LookupError, TypeError):
        return ""
    return token if isinstance(token, str) else ""

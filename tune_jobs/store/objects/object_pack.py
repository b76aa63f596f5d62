"""A pack in an object store; see `pack_contract.Pack`."""

from __future__ import annotations

import json
import threading
import time
import weakref
from pathlib import Path
from typing import Any

from policies.errors import MALFORMED, CheckpointError, NotFoundError
from tune_jobs.store import names
from tune_jobs.store.logs import begin_log, log_tail
from tune_jobs.store.objects.bucket import StorageError
from tune_jobs.store.objects.logs import LogUploads
from tune_jobs.store.objects.owners import ObjectOwner
from tune_jobs.store.objects.parts import Parts
from tune_jobs.store.objects.scratch import make_local
from tune_jobs.store.pack_contract import Assignment
from tune_jobs.store.places import check_pack_id
from tune_jobs.store.trial_contract import Ownership

_READ_EVERY_S = 0.25
"""Seconds between two looks at an assignment: a pack asks before every step, which must not wait for the store."""
_READ_FOR_S = 5.0
"""Seconds for which it is looked at after it was asked for: a pack may be told by its driver from then on."""


class ObjectPack:
    """One pack's objects; implements `Pack`.

    Args:
        parts: The sweep's objects.
        pack_id: `p00` and so on.

    Raises:
        NotFoundError: This cannot be a pack's id.
    """

    def __init__(self, parts: Parts, pack_id: str) -> None:
        self.pack_id = check_pack_id(pack_id)
        self._parts = parts
        self._known: Assignment | CheckpointError | StorageError = Assignment()
        self._is_read = False
        self._uploads: LogUploads | None = None
        self._written: dict[str, Any] | None = None
        self._looking: threading.Thread | None = None
        self.asked_at = 0.0
        """When the assignment was read last, by the monotonic clock."""

    def __reduce__(self) -> tuple[Any, ...]:
        return ObjectPack, (self._parts, self.pack_id)

    @property
    def _prefix(self) -> str:
        return f"{names.PACKS_FOLDER}/{self.pack_id}"

    def take(self, under: Ownership | None = None) -> ObjectOwner:
        """Become the process that runs this pack; see `Pack.take`."""
        return ObjectOwner.take(self._parts.bucket, f"{self._prefix}.owner.json", under, is_run=False)

    def write(self, assignment: Assignment, *, soon: bool = False) -> None:
        """Replace the assignment."""
        data = assignment.as_json()
        if data == self._written:
            # A driver writes it after every report; if it is not the pack's any more, it hears so elsewhere.
            return
        if not soon:
            # The members' records are read when they are begun.
            self._parts.settle()
        self._parts.write_record(f"{self._prefix}.json", json.dumps(data) + "\n", soon=soon)
        self._written = data

    def read(self) -> Assignment:
        """Read the assignment, as it was a moment ago; see `Pack.read`."""
        self.asked_at = time.monotonic()
        if self._looking is None or not self._looking.is_alive():
            if self._is_read:
                self.look()
            else:
                self._known, self._is_read = self._now(), True
            self._looking = threading.Thread(
                target=_keep_reading, args=(weakref.ref(self),), name="assignment", daemon=True
            )
            self._looking.start()
        known = self._known
        if isinstance(known, Exception):
            raise known
        return known

    def look(self) -> None:
        """Read it anew, for `read`."""
        try:
            self._known = self._now()
        except CheckpointError as error:
            self._known = error
        except StorageError as error:
            # The store may be away for a while; the pack goes on with what it was told.
            if not error.passes:
                self._known = error

    def _now(self) -> Assignment:
        name = self._parts.bucket.name_of(f"{self._prefix}.json")
        try:
            found = self._parts.bucket.get(f"{self._prefix}.json")
            return Assignment.from_json(json.loads(found.data if found is not None else b""))
        except (NotFoundError, *MALFORMED) as error:
            raise CheckpointError(
                f"{name} does not say which trials pack {self.pack_id} trains: {repr(error)[:400]}.",
                "Check that all nodes reach the storage, and resume the sweep.",
            ) from error

    @property
    def log_path(self) -> Path:
        """A file of this machine that the pack's process appends its output to."""
        folder = self._parts.shared() / names.PACKS_FOLDER
        make_local(folder)
        return folder / f"{self.pack_id}.log"

    def begin_log(self) -> None:
        """Print the line that separates this process's output from that of earlier ones, and begin to upload it."""
        begin_log(self._what)
        self._uploads = LogUploads(self._parts, f"{self._prefix}.log", self.log_path)

    def log_tail(self, num_lines: int = 15) -> str:
        """Return the lines that say how the pack's last process ended."""
        return log_tail(self._parts.newest_log(f"{self._prefix}.log", self.log_path), self._what, num_lines)

    @property
    def _what(self) -> str:
        return f"pack {self.pack_id}"


def _keep_reading(pack: weakref.ref[ObjectPack]) -> None:
    """Look at a pack's assignment as long as somebody asks for it."""
    while True:
        time.sleep(_READ_EVERY_S)
        present = pack()
        if present is None or time.monotonic() - present.asked_at > _READ_FOR_S:
            return
        present.look()
        del present

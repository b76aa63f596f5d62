"""What all parts of a sweep in an object store share: its objects, this machine's folders, and the records."""

from __future__ import annotations

import contextlib
import re
import secrets
import threading
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from policies.errors import NotFoundError, TuneJobsError
from policies.files import open_to_append
from tune_jobs.store.objects.bucket import Bucket, ConflictError, Found, Listed, StorageError, Tag
from tune_jobs.store.objects.held import held
from tune_jobs.store.objects.outbox import outbox
from tune_jobs.store.objects.owners import ObjectOwner
from tune_jobs.store.objects.scratch import filling, own_folder, shared_folder, write_local
from tune_jobs.store.objects.url import ObjectUrl
from tune_jobs.store.ownership import OwnershipLostError
from tune_jobs.store.record_files import dump, read_record

_RecordT = TypeVar("_RecordT", bound=BaseModel)

RECORDS = "records"
_EVENTS_AFTER_S = 10.0
_EVENTS_BYTES = 2**18
"""A file that grows is uploaded whole each time: a larger one is left, and another one begun."""
_REMOVED_AFTER_S = 3.0
_ATTEMPTS = 20


@dataclass
class _Known:
    """A record's content in the store, as this process has seen or written it last."""

    data: bytes
    tag: Tag
    as_of: object | None
    """The snapshot that it belongs to."""


class Parts:
    """The objects of one sweep, as one process sees them.

    Args:
        url: The sweep's address.
    """

    def __init__(self, url: ObjectUrl) -> None:
        self.bucket = Bucket(url)
        self.run: ObjectOwner | None = None
        """The run that this process works for, which its records are written under."""
        self.is_locked: Callable[[], bool] | None = None
        """Whether this process still has the sweep's lock; None: it has not taken it."""
        self.snapshot: object | None = None
        """While much is read, what everything that was read since then is as of; None: all is read anew."""
        self._known: dict[str, _Known] = {}
        self._listed: tuple[object, dict[str, Listed]] | None = None
        self._own: Path | None = None
        self._writer = secrets.token_hex(4)
        self.jobs: set[Hashable] = set()
        """What this process may still have to upload here."""
        self._tags: dict[str, Tag | None] = {}
        self._pending: dict[str, bytes] = {}
        self._gone: set[str] = set()
        self._num_left: dict[str, int] = {}
        """How many large files are left, of those that grow."""
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        return Parts, (self.bucket.url,)

    # -- folders of this machine

    def own(self) -> Path:
        """Return a folder of this process alone, which lives as long as this."""
        if self._own is None:
            self._own = own_folder(self)
        return self._own

    def shared(self) -> Path:
        """Return the sweep's folder that the processes of this machine share."""
        return shared_folder(self.bucket.url)

    @contextlib.contextmanager
    def named(self) -> Iterator[None]:
        """Let errors of what is read in the block name the store and not this process's folder."""
        try:
            yield
        # Where a file of this machine cannot be written, its folder is what matters.
        except (NotFoundError, StorageError) as error:
            local = re.compile(rf"{re.escape(str(self.own()))}(/[0-9a-f]{{8}}(?=/))?")
            message, hint = (local.sub(lambda _: self.bucket.url.short, text) for text in (error.message, error.hint))
            raise error.again(message, hint) from error.__cause__

    # -- records: small objects that are replaced whole

    def record_key(self, trial_id: str) -> str:
        """Return the key of a trial's record: all lie side by side, so that they are listed together."""
        return f"{RECORDS}/{trial_id}.json"

    def read_record(
        self, key: str, kind: type[_RecordT], what: str, *, is_sealed: bool = False, listed: Listed | None = None
    ) -> _RecordT:
        """Read a record.

        Args:
            key: Its object.
            kind: Its model.
            what: What it is, for messages.
            is_sealed: Whether it has a checksum of itself.
            listed: What a listing has just said of the object; it is not fetched if that content is known.

        Raises:
            NotFoundError: There is none.
            CheckpointError: It is damaged, of a newer format, or was changed; the message names it.
            CannotRunError: This machine's copy of it cannot be written.
        """
        data = self._pending.get(key)
        known = self._known.get(key)
        if data is None and known is not None and (self._is_of_snapshot(known) or _is_same(known, listed)):
            data = known.data
        if data is None:
            data = self.fetch_record(key)
            if data is None:
                hint = "List the sweeps there with `tune-jobs list --storage`."
                raise NotFoundError(f"No {what} at {self.bucket.name_of(key)}.", hint)
        # By the same code as a file's.
        path = self.own() / key
        with self._lock:
            with filling():
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)
            with self.named():
                return read_record(path, kind, what, is_sealed=is_sealed)

    def _is_of_snapshot(self, known: _Known) -> bool:
        return known.as_of is not None and known.as_of is self.snapshot

    def fetch_record(self, key: str, listed: Listed | None = None) -> bytes | None:
        """Return a record's text from the store, which is kept while much is read; None: there is none.

        Args:
            key: The record.
            listed: What a listing has just said of it; it is not fetched if that content is known.
        """
        known, as_of = self._known.get(key), self.snapshot
        if known is not None and _is_same(known, listed):
            known.as_of = as_of
            return known.data
        found = self._found(key)
        if found is None:
            return None
        self._known[key] = _Known(found.data, found.tag, as_of)
        return found.data

    def _found(self, key: str) -> Found | None:
        # Who holds the sweep's lock knows what it has written itself.
        ours = held(self.bucket.url)
        found, mark = (None, None) if ours is None else (ours.found(key), ours.mark())
        if found is None:
            if ours is not None and ours.is_absent(key):
                return None
            found = self.bucket.get(key)
            if ours is not None and found is not None:
                ours.note(key, found, mark)
        return found

    def listed_records(self) -> dict[str, Listed]:
        """Return the records of trials by their keys; while much is read, they are listed once.

        Raises:
            StorageError: They cannot be listed.
        """
        as_of = self.snapshot
        if as_of is not None and self._listed is not None and self._listed[0] is as_of:
            return self._listed[1]
        found = self.listed(f"{RECORDS}/")
        self._listed = as_of, found
        return found

    def listed(self, prefix: str) -> dict[str, Listed]:
        """Return the objects, by their keys, below one of the prefixes that the sweep's driver alone writes below.

        Raises:
            StorageError: They cannot be listed.
        """
        ours = held(self.bucket.url)
        known, mark = (None, None) if ours is None else (ours.listed(prefix), ours.mark())
        found = {item.key: item for item in self.bucket.listed(prefix)} if known is None else known
        if ours is not None and known is None:
            ours.note_listed(prefix, found, mark)
        return found

    def write_record(self, key: str, record: BaseModel | str, *, soon: bool = False, after_s: float = 0.0) -> None:
        """Replace a record, atomically.

        Args:
            key: Its object.
            record: The record, or its text.
            soon: Whether it may be in the store a little later; `settle` waits for it.
            after_s: Seconds in which a newer one may come, which is written instead; for `soon`.

        Raises:
            OwnershipLostError: Another process runs the sweep by now; the record is the other's.
            CannotRunError: It cannot be written.
        """
        data = (record if isinstance(record, str) else dump(record)).encode()
        self._pending[key] = data
        self._listed = None
        if soon:
            self.jobs.add(self._job(key))
            outbox().add(self._job(key), lambda: self._upload(key), after_s=after_s)
            return
        outbox().forget([self._job(key)])
        try:
            self._upload(key)
        except BaseException:
            self._pending.pop(key, None)
            raise

    def remove_record(self, key: str) -> None:
        """Remove a record at once.

        Raises:
            StorageError: It cannot be removed.
        """
        ours = held(self.bucket.url)
        if ours is not None and ours.is_absent(key):
            return
        self.bucket.delete([key])
        self._tags.pop(key, None)
        self._known.pop(key, None)
        if ours is not None:
            ours.forget(key)

    def tag_of(self, key: str) -> Tag:
        """Return what the content of a record is known by that this process has written last."""
        return self._known[key].tag

    def settle(self) -> None:
        """Wait until all records are in the store.

        Raises:
            OwnershipLostError: Another process runs the sweep by now.
            CannotRunError: One cannot be written.
        """
        outbox().settle([self._job(key) for key in list(self._pending)])

    def _job(self, key: str) -> Hashable:
        return "record", self._writer, key

    def _upload(self, key: str) -> None:
        data = self._pending.get(key)
        if data is None:
            return
        for _ in range(_ATTEMPTS):
            if key not in self._tags:
                # Whoever is the owner after this look has written nothing yet, or what is written over is not this.
                ours = held(self.bucket.url)
                found = None if ours is None else ours.found(key)
                if found is None and (ours is None or not ours.is_absent(key)):
                    found = self.bucket.get(key)
                    self._check_ours()
                self._tags[key] = found.tag if found is not None else None
            tag = self._tags[key]
            try:
                self._tags[key] = self._put(key, data, tag)
            except ConflictError:
                # Looked at again, and whether it is still this process's.
                del self._tags[key]
            else:
                # What is read of it from now on, by a listing that has this tag or while much is read.
                self._known[key] = _Known(data, self._tags[key] or (None, None), self.snapshot)
                self._listed = None
                break
        else:
            raise StorageError(
                f"{self.bucket.name_of(key)} is written by several processes at once.", "End all but one of them."
            )
        if self._pending.get(key) is data:
            self._pending.pop(key, None)

    def _put(self, key: str, data: bytes, over: Tag | None) -> Tag:
        ours = held(self.bucket.url)
        if ours is None:
            return self.bucket.put(key, data, over=over, is_new=over is None)
        with ours.writing(key, data) as write:
            write.tag = tag = self.bucket.put(key, data, over=over, is_new=over is None)
        return tag

    def put_files(self, files: Mapping[str, Path]) -> dict[str, Tag]:
        """Write files that the sweep's driver alone writes, side by side; see `Bucket.put_all`."""
        ours = held(self.bucket.url)
        if ours is None:
            return self.bucket.put_all(files)
        writes, tags = {key: ours.begin(key) for key in files}, dict[str, Tag]()
        try:
            tags = self.bucket.put_all(files)
        finally:
            for key, write in writes.items():
                ours.end(write, None, tags.get(key), files[key].stat().st_size)
        return tags

    def _check_ours(self) -> None:
        """Find out whether this process may write over what another one has written.

        Raises:
            OwnershipLostError: It may not.
        """
        ours = held(self.bucket.url)
        if ours is not None and ours.is_known:
            # Nobody else takes the run as long as this process has the lock.
            return
        if self.run is not None:
            self.run.check()
        elif self.is_locked is not None and not self.is_locked():
            raise OwnershipLostError(
                f"Another process drives {self.bucket.url.short} by now.",
                "Leave it to that process; this one writes nothing there any more.",
            )

    # -- what nobody needs any more

    def remove_later(self, keys: Collection[str]) -> None:
        """Remove objects that nothing names any more, together with others; it is not told if they cannot be."""
        if not keys:
            return
        job = "gone", self._writer
        with self._lock:
            self._gone.update(keys)
        self.jobs.add(job)
        with contextlib.suppress(TuneJobsError):
            outbox().add(job, self._remove, after_s=_REMOVED_AFTER_S)

    def _remove(self) -> None:
        with self._lock:
            gone, self._gone = sorted(self._gone), set()
        with contextlib.suppress(StorageError):
            self.bucket.delete(gone)

    # -- files that grow

    def append(self, key: str, data: bytes) -> None:
        """Append to a file that only this process writes to; it is uploaded from time to time.

        What comes after a large one begins another file, `KEY.0002` and so on, which is sorted behind it.
        """
        num_left = self._num_left.get(key, 0)
        present = f"{key}.{num_left + 1:04d}" if num_left else key
        path = self.own() / "appended" / present
        with filling(), open_to_append(path) as file:
            file.write(data)
            if file.tell() >= _EVENTS_BYTES:
                self._num_left[key] = num_left + 1
        job = "appended", str(path)
        self.jobs.add(job)
        outbox().add(job, lambda: self._upload_file(present, path), after_s=_EVENTS_AFTER_S)

    def _upload_file(self, key: str, path: Path) -> None:
        self.bucket.put(key, path.read_bytes())

    def newest_log(self, key: str, local: Path) -> Path:
        """Return a local file with a log: this machine's, or a copy of the store's if that is newer."""
        try:
            listed = self.bucket.look(key)
        except StorageError:
            # It is asked for to say how something failed, which may be this.
            return local
        with contextlib.suppress(OSError):
            if listed is None or local.stat().st_mtime >= listed.modified_s:
                return local
        copy = self.own() / "logs" / key
        found = self.bucket.get(key) if listed is not None else None
        if found is None:
            return local
        write_local(copy, found.data)
        return copy


def _is_same(known: _Known, listed: Listed | None) -> bool:
    """Whether a listing says that an object still has the content that is known."""
    return listed is not None and listed.tag[0] is not None and listed.tag[0] == known.tag[0]

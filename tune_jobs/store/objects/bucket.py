"""Read and write objects: each call does one thing to the store, whole or not at all, and says why it could not.

Requests that a server answered by an error of its own, or not at all, are repeated for a while: some by obstore, and
all that it leaves, such as conditional writes, here. What is left after that is an error. Conditions of writes are
those of the store (`If-Match`, `If-None-Match`), never a look beforehand.
"""

from __future__ import annotations

import contextlib
import errno
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from policies.errors import CannotRunError
from policies.files import atomic_path
from tune_jobs.store.objects import clients
from tune_jobs.store.objects.at_once import side_by_side
from tune_jobs.store.objects.reasons import MISSING_BUCKET, NO_STORE, reason_of
from tune_jobs.store.objects.scratch import filling
from tune_jobs.store.objects.url import ObjectUrl
from tune_jobs.store.patience import ANSWER_S, AWAY, is_impatient

if TYPE_CHECKING:
    import obstore.store

_T = TypeVar("_T")

_MAX_DELETED = 500
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 4.0
Tag = tuple[str | None, str | None]
"""What tells one content of an object from another: its entity tag and its version."""


class StorageError(CannotRunError):
    """The object store did not do it.

    Args:
        message: What could not be done, and why.
        hint: What to do.
        passes: Whether another try may do it: the store answered by an error of its own, or not at all.
        reason: Why, alone, without a full stop.
    """

    def __init__(self, message: str, hint: str = "", *, passes: bool = False, reason: str = "") -> None:
        super().__init__(message, hint)
        self.passes, self.reason = passes, reason


class ConflictError(StorageError):
    """The object is not the one that the writer knows, or there is one already."""


@dataclass(frozen=True)
class Found:
    """An object's content."""

    data: bytes
    tag: Tag


@dataclass(frozen=True)
class Listed:
    """An object, without its content."""

    key: str
    size: int
    tag: Tag
    modified_s: float
    """By the store's clock, in seconds since 1970."""


class Bucket:
    """All objects whose keys begin with an address.

    Args:
        url: The address.
    """

    def __init__(self, url: ObjectUrl) -> None:
        self.url = url
        # For those who wait, and for those who want an answer now.
        self._opened: dict[bool, obstore.store.ObjectStore] = {}
        self._before = f"{url.prefix}/" if url.prefix else ""

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": {}}

    @property
    def _store(self) -> obstore.store.ObjectStore:
        # Opened when it is needed: obstore takes 0.1 s to load, and an address alone needs none.
        now = is_impatient()
        if now not in self._opened:
            self._opened[now] = clients.client_of(self.url, now=now)
        return self._opened[now]

    def _path(self, key: str) -> str:
        """Return where an object is in the bucket: its connections know of no address within it."""
        # A slash at the beginning is none of the key's, for obstore.
        return self._before + key.removeprefix("/")

    def _listed(self, meta: Any) -> Listed:
        key = meta["path"].removeprefix(self._before)
        return Listed(key, meta["size"], _tag(meta), meta["last_modified"].timestamp())

    def get(self, key: str) -> Found | None:
        """Return an object; None: there is none.

        Raises:
            StorageError: It cannot be read.
        """
        import obstore

        def read() -> Found | None:
            try:
                answer = obstore.get(self._store, self._path(key))
            except FileNotFoundError as error:
                self._refuse_missing_bucket(error)
                return None
            return Found(bytes(answer.bytes()), _tag(answer.meta))

        return self._doing("read", key, read)

    def is_store(self) -> bool:
        """Find out whether an object store answers: a web server's page, say, reads as a list of nothing.

        Raises:
            StorageError: What answers is none, or cannot be read.
        """
        if self.get(secrets.token_hex(8)) is not None:
            raise StorageError(f"{self.url.short} cannot be read: {NO_STORE[0]}.", NO_STORE[1], reason=NO_STORE[0])
        return True

    def look(self, key: str) -> Listed | None:
        """Return what is known of an object without its content; None: there is none.

        Raises:
            StorageError: It cannot be found out.
        """
        import obstore

        def ask() -> Listed | None:
            try:
                return self._listed(obstore.head(self._store, self._path(key)))
            except FileNotFoundError:
                # The answer has no body that says whether it is the object or the bucket that is missing.
                self.get(key)
                return None

        return self._doing("read", key, ask)

    def fetch(self, key: str, path: Path) -> bool:
        """Write an object to a local file, which appears whole; return False if there is none.

        Raises:
            StorageError: It cannot be read.
            CannotRunError: The file cannot be written.
        """
        import obstore

        def read() -> bool:
            try:
                answer = obstore.get(self._store, self._path(key))
            except FileNotFoundError as error:
                self._refuse_missing_bucket(error)
                return False
            with filling(), atomic_path(path) as temporary, temporary.open("wb") as file:
                for part in answer.stream(min_chunk_size=2**22):
                    file.write(part)
            return True

        return self._doing("read", key, read)

    def put(self, key: str, data: bytes | Path, *, over: Tag | None = None, is_new: bool = False) -> Tag:
        """Write an object: it is there when this returns.

        Args:
            key: Its name.
            data: Its content, or a file with it.
            over: The content that it replaces; another one stays. None: whatever is there.
            is_new: Whether there has to be none.

        Returns:
            What it is known by from now on.

        Raises:
            ConflictError: Something else is there; nothing was written.
            FileNotFoundError: There is no such file.
            StorageError: It cannot be written.
        """
        import obstore
        from obstore.exceptions import AlreadyExistsError, PreconditionError

        if isinstance(data, Path) and not data.exists():
            raise FileNotFoundError(errno.ENOENT, "there is no such file", str(data))

        mode: Any = "create" if is_new else "overwrite"
        if over is not None:
            known = zip(("e_tag", "version"), over, strict=True)
            mode = {name: value for name, value in known if value is not None}

        def write() -> Tag:
            try:
                # In one request: a content in parts has no conditions.
                in_parts = False if over or is_new else None
                return _tag(obstore.put(self._store, self._path(key), data, mode=mode, use_multipart=in_parts))
            except (AlreadyExistsError, PreconditionError) as error:
                if not (over or is_new) or "RequestConflict" in str(error):
                    # Two writes at once: the store has done neither, perhaps.
                    raise
                found = self._is_there(key, data) if isinstance(data, bytes) else None
                if found is not None:
                    # The request was repeated after its answer was lost.
                    return found
                raise ConflictError(
                    f"{self.name_of(key)} was written by another process.", "Leave the sweep to that process."
                ) from None
            except FileNotFoundError as error:
                if over is not None and "NoSuchKey" in str(error):
                    raise ConflictError(f"{self.name_of(key)} is gone.", "Look who removed it.") from None
                raise

        return self._doing("written", key, write)

    def _is_there(self, key: str, data: bytes) -> Tag | None:
        found = self.get(key)
        return found.tag if found is not None and found.data == data else None

    def put_all(self, files: Mapping[str, Path]) -> dict[str, Tag]:
        """Write local files to objects, side by side, and return what each is known by; see `put`.

        Args:
            files: The files by the objects' keys.

        Raises:
            FileNotFoundError: There is no such file.
            StorageError: One cannot be written; others may have been.
        """
        tags = side_by_side(lambda item: self.put(item[0], item[1]), files.items())
        return dict(zip(files, tags, strict=True))

    def fetch_all(self, paths: Mapping[str, Path]) -> dict[str, bool]:
        """Write objects to local files, side by side, and return which there are; see `fetch`.

        Args:
            paths: The files by the objects' keys.

        Raises:
            StorageError: One cannot be read; others may have been.
            CannotRunError: A file cannot be written.
        """
        found = side_by_side(lambda item: self.fetch(item[0], item[1]), paths.items())
        return dict(zip(paths, found, strict=True))

    def delete(self, keys: Iterable[str]) -> None:
        """Remove objects; those that do not exist are none.

        Raises:
            StorageError: They cannot be removed.
        """
        import obstore

        wanted = list(keys)
        for begin in range(0, len(wanted), _MAX_DELETED):
            part = wanted[begin : begin + _MAX_DELETED]

            def remove(paths: Sequence[str] = tuple(map(self._path, part))) -> None:
                try:
                    obstore.delete(self._store, paths)
                except FileNotFoundError as error:
                    self._refuse_missing_bucket(error)
                    # Stores that remove one after the other stop at one that is missing.
                    for path in paths:
                        with contextlib.suppress(FileNotFoundError):
                            obstore.delete(self._store, path)

            self._doing("removed", part[0], remove)

    def listed(self, prefix: str = "") -> Sequence[Listed]:
        """Return what lies below a key, at any depth, by key.

        Raises:
            StorageError: It cannot be listed.
        """
        import obstore

        def look() -> list[Listed]:
            pages = obstore.list(self._store, self._path(prefix) or None)
            return sorted((self._listed(item) for page in pages for item in page), key=lambda item: item.key)

        return self._doing("listed", prefix, look)

    def children(self, prefix: str = "") -> tuple[list[str], list[Listed]]:
        """Return the names of the folders directly below a key, and the objects there.

        Raises:
            StorageError: They cannot be listed.
        """
        import obstore

        def look() -> tuple[list[str], list[Listed]]:
            found = obstore.list_with_delimiter(self._store, self._path(prefix) or None)
            names = sorted(path.rstrip("/").rpartition("/")[2] for path in found["common_prefixes"])
            return names, sorted((self._listed(item) for item in found["objects"]), key=lambda item: item.key)

        return self._doing("listed", prefix, look)

    def name_of(self, key: str) -> str:
        """Return the address of an object for messages."""
        return f"{self.url.short}/{key}" if key else self.url.short

    def _refuse_missing_bucket(self, error: Exception) -> None:
        # Azure's word, and Google's sentence, for it.
        if any(said in str(error) for said in MISSING_BUCKET):
            raise error

    def _doing(self, what: str, key: str, do: Callable[[], _T]) -> _T:
        store, now = f"{self.url.scheme}://{self.url.bucket} {self.url.settings}", is_impatient()
        away = AWAY.error(store) if now else None
        if away is not None:
            why, hint = (str(item) for item in away.args)
            raise StorageError(f"{self.name_of(key)} cannot be {what}: {why}.", hint, passes=True)
        deadline, pause = time.monotonic() + (ANSWER_S / 2 if now else clients.PATIENCE_S), _FIRST_PAUSE_S
        while True:
            try:
                with self._told(what, key):
                    done = do()
                AWAY.answered(store)
                return done
            except StorageError as error:
                if not error.passes:
                    AWAY.answered(store)
                    raise
                if time.monotonic() + pause > deadline:
                    if now:
                        AWAY.failed(store, CannotRunError(error.reason, error.hint))
                    raise
            time.sleep(pause)
            pause = min(2 * pause, _LONGEST_PAUSE_S)

    @contextlib.contextmanager
    def _told(self, what: str, key: str) -> Iterator[None]:
        from obstore.exceptions import BaseError

        try:
            yield
        except CannotRunError:
            raise
        except (BaseError, OSError, ValueError) as error:
            reason = reason_of(error, self.url.short)
            message = f"{self.name_of(key)} cannot be {what}: {reason.text}."
            raise StorageError(message, reason.hint, passes=reason.passes, reason=reason.text) from None


def _tag(meta: Any) -> Tag:
    return meta.get("e_tag"), meta.get("version")

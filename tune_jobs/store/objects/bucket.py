"""Read and write objects: each call does one thing to the store, whole or not at all, and says why it could not.

obstore repeats requests that a server answered by an error of its own, or not at all. What is left after that is an
error here. Conditions of writes are those of the store (`If-Match`, `If-None-Match`), never a look beforehand.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from policies.errors import CannotRunError
from policies.files import atomic_path
from tune_jobs.store.objects.url import ObjectUrl

if TYPE_CHECKING:
    import obstore.store

_T = TypeVar("_T")

REQUEST_TIMEOUT_S = 30.0
"""Seconds that one request may take."""
_PATIENCE_S = 30.0
"""Seconds in which requests that failed for reasons that pass are repeated."""
_MAX_DELETED = 500
_CODE, _MESSAGE = re.compile(r"<Code>([^<]{1,80})</Code>"), re.compile(r"<Message>([^<]{1,300})</Message>")
_CAUSE = re.compile(
    r"error sending request|timed? ?out|connection refused|dns error|tcp connect error|connection reset|"
    r"connection closed|InvalidCertificate|missing credentials",
    re.IGNORECASE,
)
_STATUS = re.compile(r"status code: (\d{3})[^:\n]{0,40}")

Tag = tuple[str | None, str | None]
"""What tells one content of an object from another: its entity tag and its version."""


class StorageError(CannotRunError):
    """The object store did not do it.

    Args:
        message: What could not be done, and why.
        hint: What to do.
        passes: Whether another try may do it: the store answered by an error of its own, or not at all.
    """

    def __init__(self, message: str, hint: str = "", *, passes: bool = False) -> None:
        super().__init__(message, hint)
        self.passes = passes


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
        self._opened: obstore.store.ObjectStore | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {"url": self.url, "_opened": None}

    @property
    def _store(self) -> obstore.store.ObjectStore:
        # Opened when it is needed: obstore takes 0.1 s to load, and an address alone needs none.
        if self._opened is None:
            self._opened = _open(self.url)
        return self._opened

    def get(self, key: str) -> Found | None:
        """Return an object; None: there is none.

        Raises:
            StorageError: It cannot be read.
        """
        import obstore

        def read() -> Found | None:
            try:
                answer = obstore.get(self._store, key)
            except FileNotFoundError as error:
                self._refuse_missing_bucket(error)
                return None
            return Found(bytes(answer.bytes()), _tag(answer.meta))

        return self._doing("read", key, read)

    def look(self, key: str) -> Listed | None:
        """Return what is known of an object without its content; None: there is none.

        Raises:
            StorageError: It cannot be found out.
        """
        import obstore

        def ask() -> Listed | None:
            try:
                return _listed(obstore.head(self._store, key))
            except FileNotFoundError as error:
                self._refuse_missing_bucket(error)
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
                answer = obstore.get(self._store, key)
            except FileNotFoundError as error:
                self._refuse_missing_bucket(error)
                return False
            with atomic_path(path) as temporary, temporary.open("wb") as file:
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
            StorageError: It cannot be written.
        """
        import obstore
        from obstore.exceptions import AlreadyExistsError, PreconditionError

        mode: Any = "create" if is_new else "overwrite"
        if over is not None:
            known = zip(("e_tag", "version"), over, strict=True)
            mode = {name: value for name, value in known if value is not None}

        def write() -> Tag:
            try:
                # In one request: a content in parts has no conditions.
                in_parts = False if over or is_new else None
                return _tag(obstore.put(self._store, key, data, mode=mode, use_multipart=in_parts))
            except (AlreadyExistsError, PreconditionError) as error:
                found = self._is_there(key, data) if isinstance(data, bytes) and (over or is_new) else None
                if found is not None:
                    # The request was repeated after its answer was lost.
                    return found
                raise ConflictError(
                    f"{self.name_of(key)} was written by another process.", "Leave the sweep to that process."
                ) from error
            except FileNotFoundError as error:
                if over is not None and "NoSuchKey" in str(error):
                    raise ConflictError(f"{self.name_of(key)} is gone.", "Look who removed it.") from error
                raise

        return self._doing("written", key, write)

    def _is_there(self, key: str, data: bytes) -> Tag | None:
        found = self.get(key)
        return found.tag if found is not None and found.data == data else None

    def delete(self, keys: Iterable[str]) -> None:
        """Remove objects; those that do not exist are none.

        Raises:
            StorageError: They cannot be removed.
        """
        import obstore

        wanted = list(keys)
        for begin in range(0, len(wanted), _MAX_DELETED):
            part = wanted[begin : begin + _MAX_DELETED]

            def remove(part: list[str] = part) -> None:
                with contextlib.suppress(FileNotFoundError):
                    obstore.delete(self._store, part)

            self._doing("removed", part[0], remove)

    def listed(self, prefix: str = "") -> Sequence[Listed]:
        """Return what lies below a key, at any depth, by key.

        Raises:
            StorageError: It cannot be listed.
        """
        import obstore

        def look() -> list[Listed]:
            pages = obstore.list(self._store, prefix or None)
            return sorted((_listed(item) for page in pages for item in page), key=lambda item: item.key)

        return self._doing("listed", prefix, look)

    def children(self, prefix: str = "") -> tuple[list[str], list[Listed]]:
        """Return the names of the folders directly below a key, and the objects there.

        Raises:
            StorageError: They cannot be listed.
        """
        import obstore

        def look() -> tuple[list[str], list[Listed]]:
            found = obstore.list_with_delimiter(self._store, prefix or None)
            names = sorted(path.rstrip("/").rpartition("/")[2] for path in found["common_prefixes"])
            return names, sorted((_listed(item) for item in found["objects"]), key=lambda item: item.key)

        return self._doing("listed", prefix, look)

    def name_of(self, key: str) -> str:
        """Return the address of an object for messages."""
        return f"{self.url.short}/{key}" if key else self.url.short

    def _refuse_missing_bucket(self, error: Exception) -> None:
        if "NoSuchBucket" in str(error):
            raise error

    def _doing(self, what: str, key: str, do: Callable[[], _T]) -> _T:
        with self._told(what, key):
            return do()

    @contextlib.contextmanager
    def _told(self, what: str, key: str) -> Iterator[None]:
        from obstore.exceptions import BaseError, PermissionDeniedError, UnauthenticatedError

        try:
            yield
        except CannotRunError:
            raise
        except (BaseError, OSError, ValueError) as error:
            reason, passes = _reason(error)
            hint = f"Check that {self.url.short} is reached from this machine, and try again."
            is_refused = isinstance(error, PermissionDeniedError | UnauthenticatedError)
            if is_refused or reason.startswith(("status code: 401", "status code: 403")):
                hint = (
                    "Check the credentials in this process's environment (AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, "
                    "say) or its machine's role, and what they allow."
                )
            elif "NoSuchBucket" in str(error):
                hint = "Make the bucket, or correct its name in the storage's address."
            elif "301" in reason or "PermanentRedirect" in reason:
                hint = "The bucket is in another region: add ?region=REGION to the storage's address."
            raise StorageError(f"{self.name_of(key)} cannot be {what}: {reason}.", hint, passes=passes) from None


def _reason(error: Exception) -> tuple[str, bool]:
    """Return why, without what a server's answer or a request may hold of credentials; and whether it may pass."""
    text = str(error)
    code, status = _CODE.search(text), _STATUS.search(text)
    if code is not None or status is not None:
        said = _MESSAGE.search(text)
        parts = [status[0].rstrip() if status else "", code[1] if code else "", said[1].rstrip(".") if said else ""]
        number = int(status[1]) if status else 0
        return ", ".join(part for part in parts if part), number >= 500 or number == 429
    causes = _CAUSE.findall(text)
    if causes:
        return " ".join(dict.fromkeys(cause.lower() for cause in causes)), True
    first = text.strip().splitlines()[0] if text.strip() else type(error).__name__
    return re.sub(r"https?://\S+", "the store", first)[:200].rstrip("."), True


def _tag(meta: Any) -> Tag:
    return meta.get("e_tag"), meta.get("version")


def _listed(meta: Any) -> Listed:
    return Listed(meta["path"], meta["size"], _tag(meta), meta["last_modified"].timestamp())


def _open(url: ObjectUrl) -> obstore.store.ObjectStore:
    from obstore.store import AzureStore, GCSStore, S3Store

    prefix = url.prefix or None
    options: dict[str, Any] = {
        "client_options": {
            "timeout": timedelta(seconds=REQUEST_TIMEOUT_S),
            "connect_timeout": timedelta(seconds=5),
            "allow_http": url.settings.get("endpoint", "").startswith("http://"),
        },
        "retry_config": {"max_retries": 12, "retry_timeout": timedelta(seconds=_PATIENCE_S)},
    }
    endpoint = url.settings.get("endpoint")
    if url.scheme == "s3":
        if endpoint:
            # A store of one's own has its buckets in the path, and seldom a region.
            options |= {"endpoint": endpoint, "virtual_hosted_style_request": False, "region": "us-east-1"}
        if region := url.settings.get("region"):
            options["region"] = region
        return S3Store(url.bucket, prefix=prefix, **options)
    if url.scheme == "gs":
        return GCSStore(url.bucket, prefix=prefix, **options)
    if account := url.settings.get("account"):
        options["account_name"] = account
    if endpoint:
        options["endpoint"] = endpoint
    return AzureStore(url.bucket, prefix=prefix, **options)

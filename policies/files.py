"""Files that a reader never sees half of: written under a temporary name, synced, then renamed into place."""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from policies.errors import CannotRunError


def write_atomic(path: Path, data: bytes | str) -> None:
    """Write a file so that its name always holds either the old content or all of the new.

    Args:
        path: File to write; missing parent folders are made.
        data: Content; text is written as UTF-8.

    Raises:
        CannotRunError: The folder or the file cannot be written.
    """
    content = data.encode("utf-8") if isinstance(data, str) else data
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_plain(path: Path, data: bytes | str) -> None:
    """Write a file into a folder that nobody looks into yet; who shows the folder syncs what is in it.

    Args:
        path: File to write; missing parent folders are made.
        data: Content; text is written as UTF-8.

    Raises:
        CannotRunError: The folder or the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.encode("utf-8") if isinstance(data, str) else data)
    except OSError as error:
        raise _cannot_write(path, error) from error


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary name beside `path` that becomes `path` when the block ends without an error.

    It is for writers that want a file name (video encoders). The temporary name keeps the suffix of `path`.
    If the block raises, the temporary file is removed and `path` is left as it was.

    Raises:
        CannotRunError: The folder or the file cannot be written.
    """
    # Hidden, so that a listing of "*.json" or "*.mp4" never picks up an unfinished file. Made by the writer
    # itself and not by tempfile.mkstemp, whose mode 0600 would keep other users of a shared folder from
    # reading the result.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}-{secrets.token_hex(4)}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        _sync(temporary)
        temporary.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        raise _cannot_write(path, error) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _cannot_write(path: Path, error: OSError) -> CannotRunError:
    return CannotRunError(
        f"Cannot write {path}: {error.strerror or error}.",
        "Check that the folder exists, is writable and has free space, or choose another one.",
    )


def sha256_file(path: Path) -> str:
    """SHA-256 of a file's content, as 64 lower-case hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(path: Path) -> None:
    # "r+b", not "rb": Windows refuses to sync a file that is open for reading only.
    with path.open("r+b") as file:
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    # The rename itself is on disk only once the folder is. Windows, and some network file systems, cannot do
    # it.
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

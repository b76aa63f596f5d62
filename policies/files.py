"""Write files atomically, and read only regular files.

A file is written under a temporary name, synced and renamed into place, so that a reader never sees half of it. When
files are read, named pipes and devices are refused: opening a pipe may wait for ever, and a device may never end.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import platform
import re
import stat
import time
from collections.abc import Iterator
from io import BufferedReader, BufferedWriter
from pathlib import Path

from policies.errors import CannotRunError

# The parts of a temporary name: where its process ran (missing until 0.9), the process id, and random characters.
_WRITER = re.compile(r"\.((?P<place>[0-9a-f]{8})-)?(?P<pid>[0-9]+)-[0-9a-f]{8}(\.\w+)?")
# Seconds after which a temporary file of another machine counts as abandoned; its process cannot be looked up here.
_ABANDONED_AFTER_S = 24 * 3600.0
_OTHER_KINDS = {stat.S_IFDIR: "folder", stat.S_IFIFO: "named pipe", stat.S_IFSOCK: "socket"}
MAX_RECORD_BYTES = 64 * 2**20
"""The most bytes that a file with one record may have; real ones are far smaller."""


class RefusedFileError(OSError):
    """A path is not a regular file, or far too large; unlike other errors of reading, this one is permanent."""


def open_regular(path: Path) -> BufferedReader:
    """Open a file to read; never wait for another process.

    Raises:
        OSError: It cannot be opened, or it is a folder, a named pipe, a socket or a device.
    """
    return open(path, "rb", opener=_open_at_once)


def open_to_append(path: Path) -> BufferedWriter:
    """Open a log or another file that grows; missing parent folders are made.

    Raises:
        CannotRunError: It cannot be written, or is not a regular file.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return open(path, "ab", opener=_open_at_once)
    except OSError as error:
        raise _cannot_write(path, error) from error


def read_regular(path: Path, max_bytes: int | None = MAX_RECORD_BYTES) -> bytes:
    """Read a file.

    Args:
        path: The file.
        max_bytes: A larger file is refused; None: there is no bound.

    Raises:
        OSError: It cannot be read, is larger, or is not a regular file.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if max_bytes is not None and size > max_bytes:
            raise RefusedFileError(
                errno.EFBIG, f"it has {size:,} bytes, and no more than {max_bytes:,} are read", str(path)
            )
        return file.read()


def _open_at_once(path: str, flags: int) -> int:
    # Checked before, because opening a device may have effects; and after, because the path may have been replaced.
    with contextlib.suppress(FileNotFoundError):
        refuse_others(os.stat(path), path)  # noqa: PTH116 (as `open` gives it)
    descriptor = os.open(path, flags | getattr(os, "O_NONBLOCK", 0), 0o666)
    try:
        refuse_others(os.fstat(descriptor), path)
        if hasattr(os, "O_NONBLOCK"):
            # The flag would stay with the open file, also in the processes that it is passed on to.
            os.set_blocking(descriptor, True)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def refuse_others(found: os.stat_result, path: str | Path) -> None:
    """Raise an error unless a path is a regular file.

    Raises:
        RefusedFileError: It is something else; the message says what.
    """
    if not stat.S_ISREG(found.st_mode):
        kind = _OTHER_KINDS.get(stat.S_IFMT(found.st_mode), "device")
        raise RefusedFileError(errno.EINVAL, f"it is a {kind}, not a file", str(path))


def absolute(path: Path) -> Path:
    """Return a path as an absolute one.

    Raises:
        CannotRunError: The path is relative, and the working directory was deleted.
    """
    try:
        return path.absolute()
    except FileNotFoundError as error:
        raise CannotRunError(
            "The folder that this process works in was deleted.", "Change to one that exists, with `cd`, and try again."
        ) from error


def expanded(path: str | Path) -> Path:
    """Replace a ~ at the beginning of a path by a home folder; the ~ of an unknown user is kept as a name."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


def is_output_folder(path: Path) -> bool:
    """Whether a path to write to is a folder that is there already.

    Raises:
        CannotRunError: This cannot be found out, so that nothing can be written there either.
    """
    try:
        return stat.S_ISDIR(path.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:
        raise _cannot_write(path, error) from error


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
    """Write a file into a folder that is not visible to readers yet; its files are synced before it becomes visible.

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
    """Yield a temporary path beside `path` that is renamed to `path` when the block ends without an error.

    It is for writers that take a file name, such as video encoders. The temporary name keeps the suffix of `path`.
    If the block raises, the temporary file is removed and `path` is left as it was.

    Raises:
        CannotRunError: The folder or the file cannot be written.
    """
    # Hidden, so that a listing of "*.json" or "*.mp4" never picks up an unfinished file. Made by the writer
    # itself and not by tempfile.mkstemp, whose mode 0600 would keep other users of a shared folder from
    # reading the result.
    writer = f"{_this_place()}-{os.getpid()}-{os.urandom(4).hex()}"
    temporary = path.with_name(f".{path.stem}.{writer}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        sync(temporary)
        temporary.replace(path)
        sync(path.parent)  # the rename itself is on disk only once the folder is
    except OSError as error:
        raise _cannot_write(path, error) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def is_abandoned(path: Path) -> bool:
    """Whether this is a temporary file of `atomic_path` whose process was killed before it could remove the file."""
    found = _WRITER.search(path.name) if path.name.startswith(".") else None
    if found is None or found.end() != len(path.name) or path.is_symlink() or not path.is_file():
        return False
    if found["place"] == _this_place():
        return not _is_alive(int(found["pid"]))
    try:
        return time.time() - path.stat().st_mtime > _ABANDONED_AFTER_S
    except OSError:
        return False


@functools.cache
def _this_place() -> str:
    """Return eight digits for the scope of process ids: this boot of this machine, in this container."""
    # Here, as in `sha256_file`.
    import hashlib

    known = []
    with contextlib.suppress(OSError):
        known.append(Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip())
        known.append(str(Path("/proc/self/ns/pid").readlink()))
    return hashlib.sha256(" ".join([platform.node(), *known]).encode()).hexdigest()[:8]


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    # A zombie: it has ended, though its parent has not asked for its exit status, and writes no more.
    with contextlib.suppress(OSError, IndexError):
        known = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
        return known.rpartition(")")[2].split()[0] != "Z"
    return True


def _cannot_write(path: Path, error: OSError) -> CannotRunError:
    return CannotRunError(
        f"Cannot write {path}: {error.strerror or error}.",
        "Check that the folder exists, is writable and has free space, or choose another one.",
    )


def sha256_file(path: Path) -> str:
    """Return the SHA-256 of a file's content as 64 lower-case hexadecimal digits."""
    # Loading it takes a twentieth of what `tune-jobs --help` does.
    import hashlib

    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sync(path: Path) -> None:
    """Wait until a file's content, or the names in a folder, are on disk.

    Raises:
        OSError: The file cannot be opened or synced. Errors for a folder are ignored, as Windows and some network file
            systems cannot sync folders.
    """
    with contextlib.suppress(OSError) if path.is_dir() else contextlib.nullcontext():
        # Windows refuses to sync a file that is open for reading only; others may refuse to open it for writing.
        descriptor = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

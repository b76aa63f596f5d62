"""Files as answers: in ranges, and only if the client has not the same already; and several files as one archive."""

from __future__ import annotations

import contextlib
import io
import os
import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

from starlette.datastructures import Headers
from starlette.responses import FileResponse, Response, StreamingResponse
from starlette.types import Message, Receive, Scope, Send

from policies.errors import CheckpointError, NotFoundError
from policies.files import open_regular, refuse_others
from tune_jobs.service.problem_documents import problem

_PLAIN_NAME = re.compile(r"[\w.-]+", re.ASCII)
_CHUNK_BYTES = 256 * 1024
_FIRST_DAY = (1980, 1, 1, 0, 0, 0)
_ZIP64_BYTES = 2**31 - 1
_OF_NOT_MODIFIED = ("etag", "last-modified", "cache-control", "content-security-policy")

SANDBOX = "; ".join((
    "sandbox allow-scripts", "default-src 'none'", "script-src 'unsafe-inline'", "style-src 'unsafe-inline'",
    "img-src data:", "media-src data:", "font-src data:", "base-uri 'none'", "form-action 'none'",
    "frame-ancestors 'self'",
))  # fmt: skip
"""For a page of a sweep's own: its scripts run, apart from the service's pages and without any network."""
NO_SCRIPTS = "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'self'"
"""For a picture that may hold scripts."""


class Download(FileResponse):
    """A file, or the parts of it that are asked for.

    Args:
        path: The file, as the store gives it.
        media_type: What it is.
        filename: Under which name a browser keeps it; None: it shows it.
        headers: Further headers.
    """

    def __init__(
        self, path: Path, media_type: str, *, filename: str | None = None, headers: Mapping[str, str] | None = None
    ) -> None:
        try:
            found = path.lstat()
            refuse_others(found, path)
        except FileNotFoundError as error:
            raise NotFoundError(f"There is no {path.name} any more.", "Ask again.") from error
        except OSError as error:
            raise CheckpointError(f"{path.name} can't be read: {error.strerror}.", "Look at the folder.") from error
        # The inode as well: a file that was written anew in the same moment may have the same size.
        tag = f'"{found.st_ino:x}-{found.st_size:x}-{found.st_mtime_ns:x}"'
        super().__init__(
            path,
            media_type=media_type,
            filename=filename,
            stat_result=found,
            headers={"ETag": tag, "Cache-Control": "private, no-cache", **(headers or {})},
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it, or say that the client has it, or that there is no such part."""
        wanted = Headers(scope=scope).get("if-none-match")
        if wanted is not None and _matches(wanted, self.headers["etag"]):
            # A browser takes the headers of this answer over into what it has stored: what the file may do, too.
            kept = {name: self.headers[name] for name in _OF_NOT_MODIFIED if name in self.headers}
            await Response(status_code=304, headers=kept)(scope, receive, send)
            return
        refused: list[Message] = []

        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] in (400, 416):
                refused.append(message)
            if not refused:
                await send(message)

        await super().__call__(scope, receive, sending)
        if refused:
            answer = problem(refused[0]["status"], f"There is no such part: the file has {self._size:,} bytes.")
            if refused[0]["status"] == 416:
                answer.headers["Content-Range"] = f"bytes */{self._size}"
            await answer(scope, receive, send)

    @property
    def _size(self) -> int:
        assert self.stat_result is not None
        return self.stat_result.st_size


def _matches(wanted: str, tag: str) -> bool:
    known = (item.strip().removeprefix("W/") for item in wanted.split(","))
    return wanted.strip() == "*" or tag in known


def attachment(filename: str) -> str:
    """Return the header Content-Disposition for a file that a browser keeps, whatever its name has in it (RFC 6266)."""
    if _PLAIN_NAME.fullmatch(filename):
        return f'attachment; filename="{filename}"'
    return f"attachment; filename*=UTF-8''{quote(filename, safe='', errors='replace')}"


class Archive(StreamingResponse):
    """Some files as one ZIP archive, which is made while it is sent.

    Args:
        files: Their paths, by the names that they have in the archive.
        filename: The archive's.

    Raises:
        NotFoundError: One of them is gone.
    """

    media_type = "application/zip"

    def __init__(self, files: Mapping[str, Path], filename: str) -> None:
        self._opened = contextlib.ExitStack()
        try:
            # All at once: they can be read to their end even if their checkpoint is deleted meanwhile.
            streams = {name: self._opened.enter_context(open_regular(path)) for name, path in files.items()}
        except OSError as error:
            self._opened.close()
            raise NotFoundError(f"{error.filename or filename} can't be read any more.", "Ask again.") from error
        headers = {"Content-Disposition": attachment(filename), "Cache-Control": "private, no-cache"}
        super().__init__(_zipped(streams), headers=headers)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it, or as much as the client takes."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._opened.close()


def _zipped(streams: Mapping[str, BinaryIO]) -> Iterator[bytes]:
    sink = _Sink()
    # Weights hardly get smaller, and the same files always give the same archive.
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as made:
        for name, stream in streams.items():
            is_large = os.fstat(stream.fileno()).st_size > _ZIP64_BYTES
            with made.open(zipfile.ZipInfo(name, _FIRST_DAY), "w", force_zip64=is_large) as entry:
                while chunk := stream.read(_CHUNK_BYTES):
                    entry.write(chunk)
                    yield sink.taken()
    yield sink.taken()


class _Sink(io.RawIOBase):
    """Takes what is written, for whoever sends it on."""

    def __init__(self) -> None:
        super().__init__()
        self._chunks: list[bytes] = []

    def writable(self) -> bool:
        return True

    def write(self, data: Any, /) -> int:
        self._chunks.append(bytes(data))
        return len(data)

    def taken(self) -> bytes:
        chunks, self._chunks = self._chunks, []
        return b"".join(chunks)

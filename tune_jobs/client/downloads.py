"""A file of a service, on this machine: whole or not at all, and gone on with where the connection was lost."""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import BinaryIO

from policies.errors import CannotRunError
from policies.files import atomic_path, is_output_folder
from tune_jobs.client.connection import Connection
from tune_jobs.client.problems import LostConnectionError, NoServiceError

_ATTEMPTS = 6
"""How often in a row nothing new may come."""
_WAIT_S = 0.2


def download(connection: Connection, path: str, to: Path) -> Path:
    """Download a file, and return where it is.

    A file that is there is replaced, once the new one is whole.

    Args:
        connection: The service.
        path: Behind the service's address.
        to: The file to write; its folder is made, once there is something to write.

    Raises:
        NotFoundError: There is no such file.
        CannotRunError: It can't be written here, or the connection is lost again and again.
    """
    if is_output_folder(to):
        raise CannotRunError(f"{to} is a folder, not a file.", "Name a file.")
    with contextlib.ExitStack() as stack:

        def begin() -> BinaryIO:
            part = stack.enter_context(atomic_path(to))
            return stack.enter_context(part.open("wb"))

        _fetch(connection, path, begin)
    return to


def _fetch(connection: Connection, path: str, begin: Callable[[], BinaryIO]) -> None:
    """Write what is at a path to the file that `begin` opens, once there is an answer to be written."""
    file: BinaryIO | None = None
    tag, failed = "", 0
    while True:
        before = 0 if file is None else file.tell()
        # Bytes as they are in the file: by their number a part is asked for.
        headers = {"Accept": "*/*", "Accept-Encoding": "identity"}
        if before and tag:
            headers |= {"Range": f"bytes={before}-", "If-Range": tag}
        try:
            with connection.stream("GET", path, headers=headers) as answer:
                if file is None:
                    file = begin()
                if answer.status_code != 206 or _begins_at(answer.headers) != before:
                    # It is another file by now, or can't be had in parts.
                    file.seek(0)
                    file.truncate()
                tag = _strong(answer.headers.get("etag", ""))
                chunks = answer.iter_raw()
                while True:
                    with connection.reading(path):
                        chunk = next(chunks, None)
                    if chunk is None:
                        return
                    file.write(chunk)
        except (LostConnectionError, NoServiceError):
            # What can't be had in parts begins anew each time, and might do so without an end.
            failed = 0 if tag and file is not None and file.tell() > before else failed + 1
            if failed >= _ATTEMPTS or not connection.has_answered:
                raise
            time.sleep(_WAIT_S * 2**failed)


def _begins_at(headers: Mapping[str, str]) -> int | None:
    found = re.match(r"bytes (\d+)-", headers.get("content-range", ""))
    return None if found is None else int(found[1])


def _strong(tag: str) -> str:
    """Return a tag if it says that all bytes are the same, else nothing."""
    return tag if tag.startswith('"') else ""

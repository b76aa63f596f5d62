"""Places as texts: a folder, or the URL of an object store.

    /sweeps/mine
    s3://bucket/prefix/mine?endpoint=http://host:9000

A URL in a `Path` loses one of its slashes, and becomes part of the working folder where the path is made absolute; so
no place is made a `Path` before it is known to be a folder. What a URL has behind its `?` says how the store is
reached, and belongs to every place in it.
"""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

URL_SCHEMES = ("s3", "gs", "az")
"""The schemes of the object stores there are."""

_URL = re.compile(rf"({'|'.join(URL_SCHEMES)})://", re.IGNORECASE)
_FILE_URL = re.compile(r"file://", re.IGNORECASE)


def is_url(place: str | Path) -> bool:
    """Whether a place is the URL of an object store, and not a folder; `file:///x` is the folder /x."""
    return isinstance(place, str) and _URL.match(place) is not None


def folder_of(place: str | Path) -> Path:
    """Return the folder that a place is which is no URL of an object store; `file:///x` is /x."""
    if isinstance(place, str) and _FILE_URL.match(place):
        return Path(unquote(urlsplit(place).path))
    return Path(place)


def join_place(place: str, name: str) -> str:
    """Return the place of what has this name at a place; in a URL the name is quoted, and the query stays behind it."""
    if not is_url(place):
        return str(folder_of(place) / name)
    url, query = _parts(place)
    return f"{url}/{quote(name)}{query}"


def name_of_place(place: str) -> str:
    """Return the last name of a place: of a sweep's, the sweep's; empty if a URL names nothing but a bucket."""
    if not is_url(place):
        return folder_of(place).name
    _, _, path = _parts(place)[0].partition("://")
    return unquote(path.rpartition("/")[2]) if "/" in path else ""


def outer_place(place: str) -> str:
    """Return the place that a place lies in: of a sweep's, the storage's; a bucket lies in itself."""
    if not is_url(place):
        return str(folder_of(place).parent)
    url, query = _parts(place)
    return f"{url.rpartition('/')[0]}{query}" if name_of_place(place) else place


def _parts(url: str) -> tuple[str, str]:
    """Return a URL without slashes at its end, and its query with the question mark; the query may be empty."""
    path, mark, query = url.partition("?")
    return path.rstrip("/"), mark + query

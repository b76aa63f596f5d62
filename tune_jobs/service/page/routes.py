"""The routes that serve the page; all it shows comes from the REST interface."""

from __future__ import annotations

import hashlib
import mimetypes
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable

from fastapi import APIRouter, Header, HTTPException, Response

CONTENT_SECURITY_POLICY = "; ".join((
    "default-src 'self'", "script-src 'self'", "style-src 'self'", "object-src 'none'", "base-uri 'none'",
    "form-action 'self'", "frame-ancestors 'none'",
))  # fmt: skip
_HEADERS = {
    # The browser asks each time whether a file has changed: a newer version of the service takes effect at once.
    "Cache-Control": "no-cache",
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
}
# What Python makes of an ending depends on the machine's own tables; a module is not run where its type is wrong.
_MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}

router = APIRouter(include_in_schema=False)


@dataclass(frozen=True)
class _Asset:
    content: bytes
    media_type: str
    etag: str


@router.api_route("/", methods=["GET", "HEAD"])
def page(if_none_match: str | None = Header(None)) -> Response:
    """Return the page itself."""
    return _answer("page.html", if_none_match)


@router.api_route("/static/{path:path}", methods=["GET", "HEAD"])
def static(path: str, if_none_match: str | None = Header(None)) -> Response:
    """Return a file that the page needs."""
    return _answer(path, if_none_match)


def _answer(path: str, known_etag: str | None) -> Response:
    asset = _assets().get(path)
    if asset is None:
        raise HTTPException(404, "The page has no such file.")
    headers = _HEADERS | {"ETag": asset.etag}
    if known_etag is not None and asset.etag in (item.strip() for item in known_etag.split(",")):
        return Response(status_code=304, headers=headers)
    return Response(asset.content, media_type=asset.media_type, headers=headers)


@cache
def _assets() -> dict[str, _Asset]:
    """Return all files by their paths: what is not among them is not served, whatever a path says."""
    return {path: _asset(path, file.read_bytes()) for path, file in _walk(files(__package__).joinpath("static"), "")}


def _asset(path: str, content: bytes) -> _Asset:
    ending = path[path.rfind(".") :] if "." in path else ""
    media_type = _MEDIA_TYPES.get(ending) or mimetypes.guess_type(path)[0] or "text/plain; charset=utf-8"
    return _Asset(content, media_type, f'"{hashlib.sha256(content).hexdigest()[:32]}"')


def _walk(folder: Traversable, prefix: str) -> Iterator[tuple[str, Traversable]]:
    for item in folder.iterdir():
        if item.is_dir():
            yield from _walk(item, f"{prefix}{item.name}/")
        else:
            yield f"{prefix}{item.name}", item

"""Answers in JSON, compressed for clients that take them so: those about large sweeps are megabytes."""

from __future__ import annotations

import gzip

import anyio.to_thread
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MIN_BYTES = 10_000
_LEVEL = 4
_MEDIA_TYPE = "application/json"


class CompressionMiddleware:
    """Compresses large answers in JSON with gzip. Files, which are asked for in parts, and streams pass through it.

    Args:
        app: The application.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection, as ASGI has it."""
        if scope["type"] != "http" or scope["method"] == "HEAD" or not _takes_gzip(Headers(scope=scope)):
            await self._app(scope, receive, send)
            return
        begun: Message | None = None

        async def sending(message: Message) -> None:
            nonlocal begun
            if message["type"] == "http.response.start" and _is_large_json(message):
                # Its length is not known before its body is.
                begun = message
                return
            if begun is not None:
                start, begun = begun, None
                if not message.get("more_body", False):
                    message = {**message, "body": await _compressed(start, message.get("body", b""))}
                await send(start)
            await send(message)

        await self._app(scope, receive, sending)


async def _compressed(start: Message, body: bytes) -> bytes:
    """Return a body compressed, and say so in the headers of its answer."""
    # In a thread: for as long as it takes, nobody else would be answered.
    made = await anyio.to_thread.run_sync(gzip.compress, body, _LEVEL)
    headers = MutableHeaders(scope=start)
    headers["Content-Encoding"] = "gzip"
    headers["Content-Length"] = str(len(made))
    headers.add_vary_header("Accept-Encoding")
    return made


def _takes_gzip(headers: Headers) -> bool:
    for item in headers.get("accept-encoding", "").lower().split(","):
        name, _, quality = item.partition(";")
        if name.strip() in ("gzip", "*"):
            return quality.replace(" ", "") not in ("q=0", "q=0.0", "q=0.00", "q=0.000")
    return False


def _is_large_json(message: Message) -> bool:
    headers = MutableHeaders(scope=message)
    # A file has a tag, which is that of its bytes.
    if message["status"] != 200 or "etag" in headers or "content-encoding" in headers:
        return False
    is_json = headers.get("content-type", "").partition(";")[0] == _MEDIA_TYPE
    return is_json and int(headers.get("content-length", "0")) >= MIN_BYTES

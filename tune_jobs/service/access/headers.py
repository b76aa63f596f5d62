"""What browsers are told to refuse."""

from __future__ import annotations

from collections.abc import Mapping

from starlette.datastructures import MutableHeaders
from starlette.types import Message, Send

PAGE_POLICY = "; ".join((
    "default-src 'self'", "img-src 'self' data: blob:", "style-src 'self'", "script-src 'self'", "object-src 'none'",
    "base-uri 'none'", "frame-ancestors 'none'", "form-action 'self'",
))  # fmt: skip
"""For the page: all it loads comes from here, and nothing in a text of a sweep is run."""
DATA_POLICY = "default-src 'none'; img-src 'self'; media-src 'self'; base-uri 'none'; frame-ancestors 'none'"
"""For what is no page: where somebody opens it as one, it may show itself and run nothing."""

_ALWAYS: Mapping[str, str] = {
    "X-Content-Type-Options": "nosniff",
    # Not no-referrer: browsers would then hide the origin of the page's own forms.
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}


def with_security_headers(send: Send, path: str) -> Send:
    """Return a `send` that adds the headers which an answer lacks: those that a route sets stay."""

    async def sending(message: Message) -> None:
        if message["type"] in ("http.response.start", "websocket.http.response.start"):
            headers = MutableHeaders(scope=message)
            for name, value in _ALWAYS.items():
                headers.setdefault(name, value)
            # The browser has the file with its own policy, which it would replace by the default one.
            if message.get("status") != 304:
                is_page = headers.get("content-type", "").startswith("text/html")
                headers.setdefault("Content-Security-Policy", PAGE_POLICY if is_page else DATA_POLICY)
            if path.startswith("/api/"):
                # What one person may see stays in no cache that others use.
                headers.setdefault("Cache-Control", "no-store")
        await send(message)

    return sending

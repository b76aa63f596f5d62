"""Bodies of requests: read whole before a route sees them, within limits of size, time and nesting."""

from __future__ import annotations

import re
from collections.abc import Mapping

import anyio
from starlette.types import Message, Receive

from tune_jobs.service.access.refusal import RefusedError
from tune_jobs.spec.plain_data import MAX_DEPTH

MAX_JSON_DEPTH = MAX_DEPTH + 16
"""A sweep file at its deepest, in a request."""
# A string, or what opens and closes. That a string may lack its end keeps the time linear in the length.
_TOKEN = re.compile(rb'"(?:[^"\\]++|\\.)*+"?|[\[{]|[\]}]', re.DOTALL)
_CLOSE = {"Connection": "close"}


class GoneError(Exception):
    """The client left before its body had arrived."""


async def read_body(receive: Receive, headers: Mapping[bytes, list[bytes]], max_bytes: int, max_s: float) -> bytes:
    """Return a request's body.

    Args:
        receive: Where it comes from.
        headers: The request's headers.
        max_bytes: How large it may be.
        max_s: How long it may take to arrive, in seconds.

    Raises:
        RefusedError: It is too large, too slow, or JSON that is nested too deep.
        GoneError: The client left.
    """
    check_length(headers, max_bytes)
    body = bytearray()
    try:
        with anyio.fail_after(max_s):
            while True:
                message = await receive()
                if message["type"] == "http.disconnect":
                    raise GoneError
                body += message.get("body", b"")
                if len(body) > max_bytes:
                    raise _too_large(max_bytes)
                if not message.get("more_body", False):
                    break
    except TimeoutError:
        raise RefusedError(
            408, f"The body of the request did not arrive within {max_s:g} s.", "Send it again.", _CLOSE
        ) from None
    if _depth(bytes(body)) > MAX_JSON_DEPTH:
        raise RefusedError(422, f"The request is nested more than {MAX_JSON_DEPTH} deep.", "Send settings, not data.")
    return bytes(body)


def check_length(headers: Mapping[bytes, list[bytes]], max_bytes: int) -> None:
    """Check the length that a request tells of its body.

    Raises:
        RefusedError: It is too long.
    """
    told = headers.get(b"content-length", [b"0"])[0]
    # A server has checked that it is a number.
    if not told.isdigit() or len(told) > 18 or int(told) > max_bytes:
        raise _too_large(max_bytes)


def receiving(body: bytes, receive: Receive) -> Receive:
    """Return a `receive` that gives a body that was read, and then what comes from the client."""
    left: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def receive_again() -> Message:
        return left.pop() if left else await receive()

    return receive_again


def _too_large(max_bytes: int) -> RefusedError:
    # The rest of it is not read, so that the connection is of no more use.
    return RefusedError(
        413, f"The body of the request is too large: at most {max_bytes:,} bytes are read.", "Send less.", _CLOSE
    )


def _depth(body: bytes) -> int:
    """Return how deep JSON is nested, if by more than the limit, else any smaller number."""
    if body.count(b"[") + body.count(b"{") <= MAX_JSON_DEPTH:
        return 0
    depth = deepest = 0
    for token in _TOKEN.finditer(body):
        first = body[token.start()]
        if first in b"[{":
            depth += 1
            if depth > MAX_JSON_DEPTH:
                return depth
            deepest = max(deepest, depth)
        elif first in b"]}":
            depth -= 1
    return deepest

"""Server-sent events of a service, as they come: after a lost connection those that came meanwhile, too."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from policies.errors import CannotRunError
from tune_jobs.client.connection import Connection
from tune_jobs.client.problems import LostConnectionError, NoServiceError, media_type_of, not_a_service

_log = logging.getLogger(__name__)

SILENCE_S = 45.0
"""A service sends something every 15 seconds; after so long the connection is gone."""
_WAIT_S = 0.5
_MOST_WAIT_S = 5.0
_MOST_BYTES = 64_000_000
"""Of one line."""
_EVENT_STREAM = "text/event-stream"


@dataclass(frozen=True)
class Event:
    """One event."""

    kind: str
    """What has happened: status, job, trials, iterations, reset or deleted; of the list: sweeps, deleted or reset."""
    data: Any
    """What there is to say of it; the service's OpenAPI document says what that is."""
    id: str | None
    """What a later call is given to go on after this event."""


class Parser:
    """Makes events of the bytes of a stream.

    Attributes:
        last_id: The id of the last event, or one that came without an event.
    """

    def __init__(self, last_id: str | None = None) -> None:
        self.last_id = last_id
        self.begin()

    def begin(self) -> None:
        """Take the bytes of another connection from now on: an event that was not whole is forgotten."""
        self._rest = b""
        self._kind, self._id, self._data = "", self.last_id, list[str]()

    def feed(self, chunk: bytes) -> Iterator[Event]:
        """Take some bytes, and give the events that are whole by then.

        Raises:
            ValueError: This is no stream of events whose data is JSON.
        """
        # By bytes: a line of an event may have characters that Python takes for the end of a line, and JSON doesn't.
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        if len(self._rest) > _MOST_BYTES:
            raise ValueError("a line has no end")
        for line in lines:
            event = self._take(line.removesuffix(b"\r").decode())
            if event is not None:
                yield event

    def _take(self, line: str) -> Event | None:
        if line:
            name, _, value = line.partition(":")
            value = value.removeprefix(" ")
            if name == "event":
                self._kind = value
            elif name == "data":
                self._data.append(value)
            elif name == "id" and "\0" not in value:
                self._id = value
            return None
        self.last_id = self._id
        kind, data = self._kind or "message", self._data
        self._kind, self._data = "", []
        return Event(kind, json.loads("\n".join(data)), self.last_id) if data else None


def follow(connection: Connection, path: str, *, last_id: str | None, patience_s: float) -> Iterator[Event]:
    """Give the events of a stream, until what it is about is deleted.

    Args:
        connection: The service.
        path: The stream.
        last_id: The event to go on after; None: from now on.
        patience_s: How long a service may be away at once.

    Raises:
        NotFoundError: There is no such thing.
        CannotRunError: The service can't be reached for longer than that, or refuses.
    """
    parser = Parser(last_id)
    away_since: float | None = None
    wait_s = _WAIT_S
    while True:
        try:
            for event in _connected(connection, path, parser):
                away_since, wait_s = None, _WAIT_S
                if event is None:
                    continue
                yield event
                if event.kind == "deleted" and path != "/api/v1/events":
                    return
            lost: CannotRunError = LostConnectionError(f"The service at {connection.url} ended the events of {path}.")
        except (LostConnectionError, NoServiceError) as error:
            if not connection.has_answered:
                raise
            lost = error
        now = time.monotonic()
        if away_since is None:
            away_since = now
            _log.info("%s It is tried again.", lost.message)
        elif now - away_since > patience_s:
            raise lost
        time.sleep(wait_s)
        wait_s = min(_MOST_WAIT_S, 2 * wait_s)


def _connected(connection: Connection, path: str, parser: Parser) -> Iterator[Event | None]:
    """Give the events of one connection, and None for whatever else shows that the service is there."""
    headers = {"Accept": _EVENT_STREAM, "Cache-Control": "no-store"}
    if parser.last_id:
        headers["Last-Event-ID"] = parser.last_id
    parser.begin()
    with connection.stream("GET", path, headers=headers, timeout_s=SILENCE_S) as answer:
        if media_type_of(answer) != _EVENT_STREAM:
            with connection.reading(path):
                answer.read()
            raise not_a_service(connection.url, answer)
        chunks = answer.iter_bytes()
        while True:
            with connection.reading(path):
                chunk = next(chunks, None)
            if chunk is None:
                return
            yield None
            try:
                yield from parser.feed(chunk)
            except ValueError as error:
                raise not_a_service(connection.url, answer, chunk) from error

"""The last events of a stream, numbered, for any number of clients that follow it at their own pace.

Clients hold no queues of their own: each knows the number of the event that it was sent last, and takes what came
after it. One that is too slow finds that this is no more, and has to begin anew, so what a stream takes of memory does
not depend on who reads it.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, NamedTuple

from pydantic_core import to_json

MAX_EVENTS = 2_000
MAX_BYTES = 8_000_000
CHUNK_BYTES = 500_000
"""About how much a client is sent at once."""


class Event(NamedTuple):
    """An event as it is sent."""

    number: int
    frame: bytes


class Taken(NamedTuple):
    """What a client is to be sent."""

    frames: bytes
    number: int
    """Of the last event in it."""


class EventLog:
    """The last events of one stream; threads may share one.

    Args:
        start: A text that tells the lives of the service apart, without `-`: a number of an earlier one means nothing.
        numbers: Gives numbers that rise; several streams may share it.
        greeting: Kinds of events of which a client that begins is sent the last one.
        max_events: How many are kept.
        max_bytes: How many bytes of them are kept, at least the last one.
    """

    def __init__(
        self,
        start: str,
        numbers: Iterator[int] | None = None,
        *,
        greeting: Collection[str] = (),
        max_events: int = MAX_EVENTS,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        self._start, self._numbers = start, numbers if numbers is not None else itertools.count(1)
        self._max_events, self._max_bytes = max_events, max_bytes
        self._greeting: dict[str, bytes | None] = dict.fromkeys(greeting)
        self._events: deque[Event] = deque()
        self._num_bytes = 0
        # What came after it is known.
        self._floor = self._last = next(self._numbers)
        self._listeners: set[Callable[[], None]] = set()
        self._lock = threading.Lock()
        self._has_ended = False

    # -- whoever has something to tell

    def add(self, events: Collection[tuple[str, Mapping[str, Any]]]) -> None:
        """Add events, each a kind and its data, and wake those who listen."""
        if not events:
            return
        encoded = [(kind, to_json(data, inf_nan_mode="null")) for kind, data in events]
        with self._lock:
            for kind, data in encoded:
                self._last = next(self._numbers)
                if kind in self._greeting:
                    self._greeting[kind] = data
                event = Event(self._last, self._frame(kind, data, self._last))
                self._events.append(event)
                self._num_bytes += len(event.frame)
            while len(self._events) > self._max_events or (self._num_bytes > self._max_bytes and len(self._events) > 1):
                gone = self._events.popleft()
                self._num_bytes -= len(gone.frame)
                self._floor = gone.number
        self._wake()

    def end(self) -> None:
        """Let all clients end when they have been sent what there is."""
        self._has_ended = True
        self._wake()

    # -- clients

    @property
    def has_ended(self) -> bool:
        """Whether nothing more is added."""
        return self._has_ended

    @property
    def last_id(self) -> str:
        """The id of the last event."""
        return self._id(self._last)

    def begin(self, last_id: str | None) -> Taken:
        """Return what a client that comes is sent first.

        Args:
            last_id: The id of the event that it was sent last; None: it has not been here before. What came since is
                sent if it is known, else an event `reset`: then all has to be asked for anew.
        """
        with self._lock:
            if last_id is None:
                greeting = [self._frame(kind, data, self._last) for kind, data in self._greeting.items() if data]
                # An id alone is no event, but a browser comes back with it.
                return Taken(b"".join([b"id: %s\n\n" % self.last_id.encode(), *greeting]), self._last)
            number = self._number(last_id)
            if number is None or not self._floor <= number <= self._last:
                return Taken(self._frame("reset", b"{}", self._last), self._last)
        return Taken(b"", number)

    def since(self, number: int) -> Taken | None:
        """Return what came after an event, as much as is sent at once; None: some of it is known no more."""
        with self._lock:
            if number < self._floor:
                return None
            frames, size = [], 0
            # Most clients are at the end, or near it.
            for event in reversed(self._events):
                if event.number <= number:
                    break
                frames.append(event)
            frames.reverse()
        last, chosen = number, list[bytes]()
        for event in frames:
            if chosen and size + len(event.frame) > CHUNK_BYTES:
                break
            chosen.append(event.frame)
            size += len(event.frame)
            last = event.number
        return Taken(b"".join(chosen), last)

    @contextlib.contextmanager
    def listening(self, wake: Callable[[], None]) -> Iterator[None]:
        """Call a function in the block whenever there is something new; it must not wait."""
        with self._lock:
            self._listeners.add(wake)
        try:
            yield
        finally:
            with self._lock:
                self._listeners.discard(wake)

    @property
    def num_listeners(self) -> int:
        """How many listen."""
        return len(self._listeners)

    def _wake(self) -> None:
        with self._lock:
            listeners = tuple(self._listeners)
        for wake in listeners:
            wake()

    def _id(self, number: int) -> str:
        return f"{self._start}-{number}"

    def _number(self, text: str) -> int | None:
        start, _, number = text.partition("-")
        is_number = number.isascii() and number.isdigit() and len(number) < 19
        return int(number) if is_number and start == self._start else None

    def _frame(self, kind: str, data: bytes, number: int) -> bytes:
        return b"id: %s\nevent: %s\ndata: %s\n\n" % (self._id(number).encode(), kind.encode(), data)

"""Connections to the service: how long one may take to send the head of a request, and how many there may be."""

from __future__ import annotations

import asyncio
import contextlib
import resource
from collections.abc import Iterator

from typing_extensions import override
from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD_S = 30.0
"""How long the head of a request may take to arrive, in seconds. The access layer limits bodies."""
_MOST_FILES = (65_536, 10_240)
"""As many as the systemd unit of the guide allows: programs that go through all numbers of descriptors take long where
the system would allow a billion. Else as many as each macOS allows, which says that it sets no limit and sets one."""


class HeadTimeoutProtocol(H11Protocol):
    """HTTP on a connection, which is closed if the head of its first or next request is not whole in time.

    uvicorn's own timeout is about a connection that has been answered and then sends nothing; one that sends nothing
    from the start, or a byte now and then, would stay for good. A request that is being answered, such as an event
    stream, and a connection that has become a websocket may take as long as they like.
    """

    _head_timer: asyncio.TimerHandle | None = None

    @override
    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._mind_head()

    @override
    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._mind_head()

    @override
    def connection_lost(self, exc: Exception | None) -> None:
        self._end_timer()
        super().connection_lost(exc)

    def _mind_head(self) -> None:
        if not self._waits_for_a_head():
            self._end_timer()
        elif self._head_timer is None:
            # Not anew with each byte: who sends one now and then would never be late.
            self._head_timer = self.loop.call_later(HEAD_S, self._close)

    def _waits_for_a_head(self) -> bool:
        if self.transport.is_closing() or self.transport.get_protocol() is not self:
            return False
        return self.cycle is None or self.cycle.response_complete

    def _end_timer(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _close(self) -> None:
        self._head_timer = None
        if self._waits_for_a_head():
            self.transport.close()


@contextlib.contextmanager
def many_files() -> Iterator[None]:
    """Let this process have as many files and connections open in the block as the system allows it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    is_raised = soft != resource.RLIM_INFINITY and any(_raise_limit(soft, hard, most) for most in _MOST_FILES)
    try:
        yield
    finally:
        if is_raised:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def _raise_limit(soft: int, hard: int, most: int) -> bool:
    wanted = most if hard == resource.RLIM_INFINITY else min(hard, most)
    if soft >= wanted:
        return False
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        return True
    return False

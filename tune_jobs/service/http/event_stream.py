"""Server-sent events: a response that goes on until the client, the service or what it is about ends."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from tune_jobs.service.event_log import EventLog
from tune_jobs.service.problem_documents import problem
from tune_jobs.service.watching import Watching

HEARTBEAT_S = 15.0
"""After so long without an event a comment is sent: who gets none for longer knows that the connection is gone."""
SLOW_S = 20.0
"""How long a client may take for what it is sent at once, before it is dropped."""
RETRY_MS = 2_000
"""When a browser comes back."""


class EventStream(Response):
    """The events of a log, from some event on.

    A client that is too slow is dropped: one that comes back with the id of its last event gets what came since, or is
    told to begin anew.

    Args:
        watching: Has a place for each client.
        log: The events.
        last_id: The id of the event that the client had last; None: it begins.
    """

    media_type = "text/event-stream"

    def __init__(self, watching: Watching, log: EventLog, last_id: str | None) -> None:
        # A proxy that collects what it passes on would pass on nothing for a long time.
        super().__init__(headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"})
        del self.headers["content-length"]
        self._watching, self._log, self._last_id = watching, log, last_id

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the events, until there are no more or the client is gone."""
        with self._watching.place() as is_free:
            if not is_free:
                answer = problem(429, f"{self._watching.max_watchers:,} clients watch already; no more may.")
                answer.headers["Retry-After"] = "30"
                await answer(scope, receive, send)
                return
            wake, loop = asyncio.Event(), asyncio.get_running_loop()
            with self._log.listening(_waker(loop, wake)):
                gone = asyncio.create_task(_wait_for_the_end(receive, wake))
                try:
                    await send({"type": "http.response.start", "status": 200, "headers": self.raw_headers})
                    is_whole = await self._send_all(send, wake, gone)
                finally:
                    gone.cancel()
            if is_whole:
                await send({"type": "http.response.body", "body": b"", "more_body": False})

    async def _send_all(self, send: Send, wake: asyncio.Event, gone: asyncio.Task[None]) -> bool:
        """Send what there is and what comes; return whether the stream came to its end."""
        taken = self._log.begin(self._last_id)
        if not await _sent(send, b"retry: %d\n\n" % RETRY_MS + taken.frames):
            return False
        while not gone.done():
            # Set before it is asked whether there is more: what comes between the two wakes it again.
            wake.clear()
            has_ended = self._log.has_ended
            more = self._log.since(taken.number)
            if more is None:
                return False
            if more.frames:
                if not await _sent(send, more.frames):
                    return False
                taken = more
                continue
            if has_ended:
                return True
            try:
                # Not `wait_for`, which makes a task each time; there may be a thousand of these.
                async with asyncio.timeout(HEARTBEAT_S):
                    await wake.wait()
            except TimeoutError:
                if not await _sent(send, b":\n\n"):
                    return False
        return False


def _waker(loop: asyncio.AbstractEventLoop, wake: asyncio.Event) -> Callable[[], None]:
    def call() -> None:
        # The loop may have been closed meanwhile.
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(wake.set)

    return call


async def _wait_for_the_end(receive: Receive, wake: asyncio.Event) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
    wake.set()


async def _sent(send: Send, body: bytes) -> bool:
    """Whether the client took it in time."""
    try:
        async with asyncio.timeout(SLOW_S):
            await send({"type": "http.response.body", "body": body, "more_body": True})
    except TimeoutError:
        return False
    return True

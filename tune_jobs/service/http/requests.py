"""The outermost layer around the application: each request has an id, is timed, and is a line of the log."""

from __future__ import annotations

import logging
import re
import time
import uuid
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from tune_jobs.service.logs import ACCESS, answering
from tune_jobs.service.metrics import Metrics
from tune_jobs.store.patience import impatient

HEADER = "X-Request-ID"
NO_ROUTE = "none"
"""Of a path that is none, and of a request that was refused before its route was looked for."""
_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:+/=-]{0,127}")
_log = logging.getLogger(ACCESS)


class RequestMiddleware:
    """Names, times and logs requests.

    A request may bring an id, which a proxy has given it; else it gets one. The answer has it, too.

    Args:
        app: The application.
        metrics: Where times are counted.
        clock: A monotonic clock, in seconds.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics, clock: Callable[[], float] = time.monotonic) -> None:
        self._app, self._metrics, self._clock = app, metrics, clock

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection, as ASGI has it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request, began = _Request(scope), self._clock()
        # The server has a task, and with it a context, for each request: what it logs of one at its end belongs to it.
        answering.set(request)
        status: int | None = None

        async def sending(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                # Until an answer begins, as an event stream goes on for hours.
                self._metrics.answered(scope["method"], request.route, status, self._clock() - began)
                MutableHeaders(scope=message)[HEADER] = request.id
            await send(message)

        try:
            # A request that waited for a store that is away would keep a thread from others that need none.
            with impatient():
                await self._app(scope, receive, sending)
        except Exception as error:
            if status is None:
                # What the server answers then.
                status = 500
                self._metrics.answered(scope["method"], request.route, status, self._clock() - began)
            elif scope.get("state", {}).get("logged") is error:
                # Starlette raises it once more when it is answered, and the server would log it once more.
                return
            raise
        finally:
            took_s = round(self._clock() - began, 6)
            told = {"method": scope["method"], "route": request.route, "status": status, "duration_s": took_s}
            answer = "no answer, as the client left" if status is None else str(status)
            _log.info("%s %s: %s", scope["method"], request.route, answer, extra=told)


class _Request:
    """What is known of a request while it is answered."""

    def __init__(self, scope: Scope) -> None:
        self._scope = scope
        self.id = _id_of(scope["headers"])

    @property
    def route(self) -> str:
        """The path as it is declared, so that it names no sweep."""
        return str(getattr(self._scope.get("route"), "path", "") or NO_ROUTE)

    def log_fields(self) -> Mapping[str, Any]:
        """Return what is known by now."""
        state, parameters = self._scope.get("state", {}), self._scope.get("path_params", {})
        caller = state.get("caller")
        return {
            "request_id": self.id,
            "caller": None if caller is None else caller.name,
            "sweep": _cut(state.get("audit_target") or parameters.get("name")),
            "trial": _cut(parameters.get("trial_id")),
        }


def _id_of(headers: Iterable[tuple[bytes, bytes]]) -> str:
    """Return the id that a request brings if it is one that a log may have, else a new one."""
    given = [value for name, value in headers if name.lower() == HEADER.lower().encode()]
    if len(given) == 1 and _ID.fullmatch(text := given[0].decode("latin-1")):
        return text
    return uuid.uuid4().hex


def _cut(value: object) -> str | None:
    return None if value is None else str(value)[:200]

"""The layer around the whole application: no request reaches a route that has not passed it.

It is ASGI alone and holds back no part of an answer, as event streams pass through it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import anyio
import anyio.lowlevel
import anyio.to_thread
from sqlalchemy.exc import SQLAlchemyError
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from tune_jobs.service.access.attempts import RateLimit
from tune_jobs.service.access.audit import Done
from tune_jobs.service.access.bodies import GoneError, check_length, read_body, receiving
from tune_jobs.service.access.callers import LOCAL, Caller
from tune_jobs.service.access.credentials import CHALLENGE, WRONG_TOKEN, Shown, cookie_name, set_cookie, shown_by
from tune_jobs.service.access.gate import Gate
from tune_jobs.service.access.headers import with_security_headers
from tune_jobs.service.access.hosts import Host, ServedNames, check_fetch_site, check_origin, public_host
from tune_jobs.service.access.proxy import Proxy, is_forwarded
from tune_jobs.service.access.refusal import RefusedError
from tune_jobs.service.access.tokens import FRESH_S, Token
from tune_jobs.service.problem_documents import database_problem

PUBLIC_PATHS = frozenset({"/", "/healthz", "/readyz", "/api/v1/login"})
PUBLIC_FOLDERS = ("/static/",)
"""What needs no token: the page's own files, which show nothing until somebody has logged in, and what monitors ask."""
_READING = frozenset({"GET", "HEAD", "OPTIONS"})
_EVENTS = b"text/event-stream"


class CutError(Exception):
    """An answer ends before it is whole, which the server says by cutting the connection."""


class AccessMiddleware:
    """Checks where a request comes from, who asks and how large it is, and writes down what was done.

    Args:
        app: The application.
        gate: What decides.
    """

    def __init__(self, app: ASGIApp, gate: Gate) -> None:
        config = gate.config
        self._app, self._gate, self._config = app, gate, config
        self._names = ServedNames(config.host, [public_host(name) for name in config.public_names])
        self._proxy = Proxy(config.behind_proxy)
        # A program that goes on showing a token which has expired is told once a minute.
        self._told = RateLimit(1, 60.0)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection, as ASGI has it.

        Raises:
            CutError: The token of a download is no longer valid.
        """
        if scope["type"] == "http":
            await self._http(_Request(scope), receive, with_security_headers(send, scope["path"]))
        elif scope["type"] == "websocket":
            await self._websocket(_Request(scope), receive, send)
        else:
            await self._app(scope, receive, send)

    async def _http(self, request: _Request, receive: Receive, send: Send) -> None:
        limits = self._config.limits
        try:
            await self._admit(request)
            if request.is_reading:
                check_length(request.headers, limits.body_bytes)
            else:
                body = await read_body(receive, request.headers, limits.body_bytes, limits.body_s)
                receive, send = receiving(body, receive), self._audited(request, send)
        except RefusedError as error:
            await error.answer()(request.scope, receive, send)
            return
        except SQLAlchemyError as error:
            self._gate.outages.failed("A request", error)
            await database_problem(error)(request.scope, receive, send)
            return
        except GoneError:
            return
        if request.secret is None:
            await self._app(request.scope, receive, send)
            return
        with anyio.CancelScope() as lifetime:
            await self._app(request.scope, receive, self._while_valid(request, request.secret, send, lifetime))
        if not lifetime.cancel_called:
            return
        if not request.is_answered_by_events:
            # With a proper end, a part of an archive would look like all of it.
            raise CutError(f"{request.method} {request.path}: its token has expired or was revoked meanwhile.")
        await send({"type": "http.response.body", "body": b"", "more_body": False})

    def _while_valid(self, request: _Request, secret: str, send: Send, lifetime: anyio.CancelScope) -> Send:
        """Return a `send` that ends a stream before its next part, once the token is no longer valid.

        Where that can't be found out just now, a stream of events ends, too: its client comes back and goes on from
        there. A download would have to begin anew, so it goes on, and it is asked again a moment later.
        """
        tokens = self._gate.tokens
        checked_at, is_stream = tokens.now(), False

        async def sending(message: Message) -> None:
            nonlocal checked_at, is_stream
            if message["type"] == "http.response.start":
                headers = _headers(message["headers"])
                is_stream = b"content-length" not in headers
                request.is_answered_by_events = headers.get(b"content-type", [b""])[0].startswith(_EVENTS)
            elif is_stream and not 0 <= tokens.now() - checked_at < FRESH_S:
                checked_at = tokens.now()
                is_valid = await self._is_valid(secret, request.client)
                if is_valid is None:
                    is_valid = not request.is_answered_by_events
                if not is_valid:
                    lifetime.cancel()
                    await anyio.lowlevel.checkpoint()
            await send(message)

        return sending

    async def _is_valid(self, secret: str, client: str) -> bool | None:
        """Whether a token is valid now; None: that is not known, as the database is away or too much is asked."""
        try:
            token = await anyio.to_thread.run_sync(self._gate.find, secret, client)
        except RefusedError:
            return None
        except SQLAlchemyError as error:
            self._gate.outages.failed("A request", error)
            return None
        return token is not None and token.state(self._gate.tokens.now()) == "valid"

    async def _websocket(self, request: _Request, receive: Receive, send: Send) -> None:
        try:
            await self._admit(request)
        except (RefusedError, SQLAlchemyError):
            # Before it was accepted, this is an answer with status 403.
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": ""})
            return
        await self._app(request.scope, receive, send)

    async def _admit(self, request: _Request) -> None:
        """Check a request by its headers, and note who asks.

        Raises:
            RefusedError: It is not let in.
        """
        self._proxy.resolve(request.scope, request.headers)
        request.host = self._names.check_host(request.headers, request.scheme, request.scope.get("server"))
        is_own = check_origin(request.headers, request.scheme, request.host)
        is_own |= check_fetch_site(request.headers, request.method)
        request.state["client"] = request.client
        request.state["cookie"] = request.cookie
        if request.path in PUBLIC_PATHS or request.path.startswith(PUBLIC_FOLDERS):
            return
        request.state["caller"] = await self._caller(request, is_own=is_own)

    async def _caller(self, request: _Request, *, is_own: bool) -> Caller:
        shown = shown_by(request.headers, request.cookie)
        if shown is None:
            if self._config.needs_token or is_forwarded(request.headers):
                raise RefusedError(
                    401,
                    "A token is needed here.",
                    "Log in on the page, or send the header `Authorization: Bearer TOKEN`; an admin of the service "
                    "makes one with `tune-jobs token make NAME --role ROLE`.",
                    {"WWW-Authenticate": CHALLENGE},
                )
            return LOCAL
        token = await self._token(request, shown)
        request.secret = shown.secret
        if shown.by_cookie and not is_own and not (request.is_reading and request.scope["type"] == "http"):
            raise RefusedError(
                403,
                "It can't be seen that this request comes from the service's own page: it has the page's cookie, and "
                "neither the header Origin nor Sec-Fetch-Site.",
                "Use a newer browser; programs send the header `Authorization: Bearer TOKEN`.",
            )
        return token.caller

    async def _token(self, request: _Request, shown: Shown) -> Token:
        tokens = self._gate.tokens
        known = tokens.remembered(shown.secret)
        if known is not None and known[1] and known[0].state(tokens.now()) == "valid":
            return known[0]
        token = await anyio.to_thread.run_sync(self._gate.find, shown.secret, request.client)
        if token is not None and token.state(tokens.now()) == "valid":
            return token
        if token is None or not self._told.begin(token.id):
            await self._write(request, "login", 401, who="" if token is None else token.name)
        headers = {"WWW-Authenticate": WRONG_TOKEN}
        if shown.by_cookie:
            # The browser would show it again with every request.
            headers["Set-Cookie"] = set_cookie(request.cookie, "", 0, is_tls=request.is_tls)
        raise RefusedError(
            401, "This token is wrong, has expired or was revoked.", "Get another one from an admin.", headers
        )

    def _audited(self, request: _Request, send: Send) -> Send:
        """Return a `send` that writes down a change before its answer goes out."""

        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start":
                caller, status = request.state.get("caller"), message["status"]
                # Of those who are nobody, wrong tokens alone are told, whose number is limited.
                if caller is not None or status == 401:
                    await self._write(request, request.action, status, who="" if caller is None else caller.name)
            await send(message)

        return sending

    async def _write(self, request: _Request, action: str, status: int, *, who: str) -> None:
        caller = request.state.get("caller")
        details = {"path": request.path} if caller is None or caller.token_id is None else {"token": caller.token_id}
        done = Done(who, request.client, action, request.target, status, details)
        await anyio.to_thread.run_sync(self._gate.audit.write, done)


class _Request:
    """What the middleware asks of a scope."""

    def __init__(self, scope: Scope) -> None:
        self.scope = scope
        self.path: str = scope["path"]
        self.method: str = scope.get("method", "GET")
        self.is_reading = self.method in _READING
        self.state: dict[str, Any] = scope.setdefault("state", {})
        self.headers = _headers(scope["headers"])
        self.host: Host
        self.secret: str | None = None
        self.is_answered_by_events = False

    @property
    def scheme(self) -> str:
        """The scheme of the client's address bar, once the proxy's word is in."""
        scheme: str = self.scope.get("scheme", "http")
        return {"ws": "http", "wss": "https"}.get(scheme, scheme)

    @property
    def is_tls(self) -> bool:
        return self.scheme == "https"

    @property
    def client(self) -> str:
        return str((self.scope.get("client") or ("unknown", 0))[0])

    @property
    def cookie(self) -> str:
        assert self.host.port is not None
        return cookie_name(self.host.port, is_tls=self.is_tls)

    @property
    def action(self) -> str:
        """The name of the route that it came to."""
        return str(getattr(self.scope.get("route"), "name", "") or f"{self.method} no route")

    @property
    def target(self) -> str:
        """The sweep that it is about."""
        return str(self.state.get("audit_target") or self.scope.get("path_params", {}).get("name", ""))


def _headers(pairs: Sequence[tuple[bytes, bytes]]) -> Mapping[bytes, list[bytes]]:
    found: dict[bytes, list[bytes]] = {}
    for name, value in pairs:
        found.setdefault(name.lower(), []).append(value)
    return found

"""For the tests of access: applications with other settings over one service, tokens, raw requests."""

import contextlib
import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import anyio
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import Engine, event
from sqlalchemy.exc import OperationalError
from starlette.types import ASGIApp, Message
from sweep_folders import make_sweep_folder

from tune_jobs.service.access.attempts import RateLimit
from tune_jobs.service.access.audit import Audit, Entry
from tune_jobs.service.access.callers import Role
from tune_jobs.service.access.gate import Gate, opened_gate
from tune_jobs.service.access.tokens import Tokens
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.http.app import make_app
from tune_jobs.service.service import Service, opened

URL = "http://127.0.0.1:8265"
OPEN: dict[str, Any] = {"host": "0.0.0.0"}
"""A service that others than this machine's users can reach."""
SWEEP = "done"
_numbers = itertools.count()


class Clock:
    """A clock that stands still until it is moved."""

    def __init__(self) -> None:
        self.s = 1_000_000.0

    def __call__(self) -> float:
        return self.s


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service with a completed sweep that was made from a terminal; its queue stands still."""
    storage = tmp_path_factory.mktemp("access") / "sweeps"
    with opened(ServiceConfig(storage=storage, port=8265, spare_idle_s=0)) as made:
        made.supervisor.close()
        make_sweep_folder(storage / SWEEP)
        yield made


@dataclass
class Place:
    """One service with settings of its own, and a clock for its tokens and its limits."""

    service: Service
    app: FastAPI
    clock: Clock

    def client(self, url: str = URL, address: str = "127.0.0.1", **headers: str) -> TestClient:
        """A client; errors of the server are answers, as over a network."""
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        return TestClient(self.app, url, raise_server_exceptions=False, headers=named, client=(address, 50_000))

    def token(self, role: Role, name: str | None = None, days: float = 1.0) -> str:
        """The secret of a new token; its name is a new one."""
        return self.service.gate.tokens.make(name or f"{role}-{next(_numbers)}", role, days)[1]

    def expired(self, role: Role) -> str:
        """The secret of a token whose time is over."""
        return Tokens(self.service.engine, lambda: self.clock.s - 3 * 86_400.0).make("late", role, 1.0)[1]

    def revoked(self, role: Role) -> str:
        """The secret of a token that was revoked."""
        tokens = self.service.gate.tokens
        token, secret = tokens.make("gone", role)
        tokens.revoke(token.id)
        return secret

    def audited(self, number: int = 1) -> list[Entry]:
        """The last entries of the audit log, the newest first."""
        return self.service.gate.audit.page(limit=number)[0]


def place(service: Service, *, limit: int = 10, **settings: Any) -> Place:
    """The service with other settings; `limit` failed logins a minute."""
    config = dataclasses.replace(service.config, **settings)
    clock = Clock()
    gate = Gate(config, Tokens(service.engine, clock), Audit(service.engine, clock), RateLimit(limit, 60.0, clock))
    made = dataclasses.replace(service, config=config, gate=gate)
    return Place(made, make_app(made), clock)


def make_token(storage: Path, name: str, role: Role) -> str:
    """The secret of a new token for the service of a storage folder, which need not run yet."""
    with opened_gate(ServiceConfig(storage=storage)) as gate:
        return gate.tokens.make(name, role)[1]


@contextlib.contextmanager
def no_space_for_tokens(engine: Engine) -> Iterator[list[str]]:
    """Let the disk be full for whatever changes tokens, for the block; yields the statements that were refused."""
    refused: list[str] = []

    def refuse(_connection: Any, _cursor: Any, statement: str, *_: Any) -> None:
        if statement.startswith("UPDATE tokens"):
            refused.append(statement)
            raise OperationalError(statement, None, Exception("database or disk is full"))

    event.listen(engine, "before_cursor_execute", refuse)
    try:
        yield refused
    finally:
        event.remove(engine, "before_cursor_execute", refuse)


def bearer(secret: str) -> dict[str, str]:
    """The header of a token."""
    return {"Authorization": f"Bearer {secret}"}


def problem(answer: Any, status: int) -> dict[str, Any]:
    """The problem document of an answer."""
    assert answer.status_code == status, (answer.status_code, answer.text)
    assert answer.headers["content-type"] == "application/problem+json"
    found: dict[str, Any] = answer.json()
    assert found["status"] == status
    assert found["detail"]
    return found


@dataclass
class Raw:
    """An answer as a server gets it."""

    status: int
    headers: list[tuple[bytes, bytes]]
    body: bytes = b""


def status_of(app: ASGIApp, method: str, path: str, headers: Mapping[str, str]) -> int:
    """The status of an answer whose body is not waited for: a stream need not end."""
    return raw_answer(app, method, path, headers, with_body=False).status


def raw_answer(
    app: ASGIApp, method: str, path: str, headers: Mapping[str, str] | None = None, *, with_body: bool = True
) -> Raw:
    """The answer to a request as a server hands it on: no client tidies up its path before."""
    found: list[Raw] = []

    async def ask() -> None:
        enough, sent = anyio.Event(), False
        with anyio.fail_after(60):

            async def receive() -> Message:
                nonlocal sent
                if sent:
                    await enough.wait()
                    return {"type": "http.disconnect"}
                sent = True
                return {"type": "http.request", "body": b"{}", "more_body": False}

            async def send(message: Message) -> None:
                if message["type"] == "http.response.start":
                    found.append(Raw(message["status"], list(message["headers"])))
                    if not with_body:
                        enough.set()
                else:
                    found[0].body += message.get("body", b"")

            given = {"host": "127.0.0.1:8265", "content-type": "application/json", **(headers or {})}
            await app(
                {
                    "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": method,
                    "path": unquote(path), "raw_path": path.encode(), "query_string": b"", "root_path": "",
                    "scheme": "http", "client": ("127.0.0.1", 50_000), "server": ("127.0.0.1", 8265),
                    "headers": [(name.lower().encode(), value.encode()) for name, value in given.items()],
                },
                receive,
                send,
            )  # fmt: skip

    anyio.run(ask)
    return found[0]

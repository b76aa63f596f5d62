"""Who gets in while clocks go back, databases go away, and headers are written as others write them."""

from collections.abc import Callable
from typing import Any

import anyio
import pytest
from service_access import OPEN, place, problem, shared  # noqa: F401 (a fixture)
from sqlalchemy.exc import OperationalError
from starlette.types import Message, Receive, Scope, Send

from tune_jobs.service.access.middleware import AccessMiddleware
from tune_jobs.service.service import Service

ME = "/api/v1/me"


@pytest.mark.parametrize("scheme", ["Bearer", "bearer", "BEARER"])
def test_the_scheme_of_a_token_is_written_in_any_case(shared: Service, scheme: str) -> None:  # noqa: F811
    at = place(shared, **OPEN)
    secret = at.token("viewer", f"who-{scheme}")
    assert at.client().get(ME, headers={"Authorization": f"{scheme} {secret}"}).json()["name"] == f"who-{scheme}"
    problem(at.client().get(ME, headers={"Authorization": f"Basic {secret}"}), 401)


def answered(app: Any, headers: list[tuple[bytes, bytes]]) -> int:
    found: list[int] = []

    async def send(message: Message) -> None:
        if message["type"] == "http.response.start":
            found.append(message["status"])

    async def receive() -> Message:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def ask() -> None:
        await app(
            {
                "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "GET", "path": ME,
                "raw_path": ME.encode(), "query_string": b"", "root_path": "", "scheme": "http",
                "client": ("127.0.0.1", 50_000), "server": ("127.0.0.1", 8265),
                "headers": [(b"host", b"127.0.0.1:8265"), *headers],
            },
            receive,
            send,
        )  # fmt: skip

    anyio.run(ask)
    return found[0]


def test_of_two_tokens_none_counts(shared: Service) -> None:  # noqa: F811
    """Who stands between may read the one, and the service the other."""
    at = place(shared, **OPEN)
    one, other = ((b"authorization", f"Bearer {at.token('viewer')}".encode()) for _ in range(2))
    statuses = [answered(at.app, headers) for headers in ([one], [other], [one, other], [other, one])]
    assert statuses == [200, 200, 401, 401]


def test_a_revoked_token_opens_nothing_though_the_clock_was_set_back(shared: Service) -> None:  # noqa: F811
    at, other = place(shared, **OPEN), place(shared, **OPEN)
    token, secret = at.service.gate.tokens.make("ann", "viewer")
    client = at.client(Authorization=f"Bearer {secret}")
    assert client.get(ME).status_code == 200
    other.service.gate.tokens.revoke(token.id)  # by a command, which is another process
    at.clock.s -= 3_600.0
    problem(client.get(ME), 401)


def test_a_token_that_this_process_revokes_opens_nothing_at_once(shared: Service) -> None:  # noqa: F811
    at = place(shared, **OPEN)
    token, secret = at.service.gate.tokens.make("ann", "viewer")
    client = at.client(Authorization=f"Bearer {secret}")
    assert client.get(ME).status_code == 200
    at.service.gate.tokens.revoke(token.id)
    problem(client.get(ME), 401)


def gone(*_: object) -> None:
    raise OperationalError("SELECT", {}, Exception("gone"))


@pytest.mark.parametrize("what", ["database gone", "clock set back and revoked"])
def test_a_stream_ends_where_nobody_can_say_that_its_token_is_valid(
    shared: Service,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
    what: str,
) -> None:
    at = place(shared, **OPEN)
    token, secret = at.service.gate.tokens.make("ann", "viewer")
    sent: list[Message] = []
    then: dict[str, Callable[[], object]] = {
        "database gone": lambda: monkeypatch.setattr(at.service.gate.tokens, "find", gone),
        "clock set back and revoked": lambda: place(at.service, **OPEN).service.gate.tokens.revoke(token.id),
    }

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-type", b"text/event-stream")]})
        for number in range(3):
            await send({"type": "http.response.body", "body": b"%d" % number, "more_body": True})
            if number == 0:
                then[what]()
                at.clock.s += -3_600.0 if "clock" in what else 2.0

    async def send(message: Message) -> None:
        sent.append(message)

    async def receive() -> Message:
        return {"type": "http.request", "body": b"", "more_body": False}

    scope = {
        "type": "http", "method": "GET", "path": "/api/v1/events", "scheme": "http", "server": ("127.0.0.1", 8265),
        "client": ("127.0.0.1", 50_000),
        "headers": [(b"host", b"127.0.0.1:8265"), (b"authorization", f"Bearer {secret}".encode())],
    }  # fmt: skip
    anyio.run(AccessMiddleware(app, at.service.gate), scope, receive, send)
    assert [message.get("body") for message in sent] == [None, b"0", b""]
    assert not sent[-1]["more_body"]

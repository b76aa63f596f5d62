"""How large a request is, and what every answer tells browsers."""

import json
from typing import Any

import anyio
import pytest
from fastapi.testclient import TestClient
from service_access import OPEN, SWEEP, URL, Place, bearer, place, problem, shared  # noqa: F401 (fixture)
from starlette.testclient import WebSocketDenialResponse
from starlette.types import Message, Receive, Scope, Send
from starlette.websockets import WebSocketDisconnect

from tune_jobs.service.access.bodies import MAX_JSON_DEPTH
from tune_jobs.service.access.middleware import AccessMiddleware
from tune_jobs.service.config import Limits
from tune_jobs.service.service import Service

# ruff: noqa: F811 - fixtures are named as arguments

ME = "/api/v1/me"


# -- bodies


def test_a_body_that_is_too_large_is_refused_by_its_length_and_by_what_comes(shared: Service) -> None:
    at = place(shared, limits=Limits(body_bytes=1_000))
    told = at.client().post("/api/v1/plans", content=b'"' + b"x" * 1_000 + b'"')
    assert "1,000 bytes" in problem(told, 413)["detail"]
    assert told.headers["connection"] == "close"
    chunks = iter([b'{"note": "', *[b"x" * 100] * 20, b'"}'])
    problem(at.client().post("/api/v1/plans", content=chunks), 413)
    problem(at.client().request("GET", ME, content=b"x" * 1_001), 413)
    problem(at.client().post("/api/v1/login", content=b"x" * 1_001), 413)
    exact = json.dumps({"preset": "cartpole-ppo"}).encode()
    client = at.client(content_type="application/json")
    assert client.post("/api/v1/plans", content=exact + b" " * (1_000 - len(exact))).status_code == 200


def test_who_may_not_come_in_has_no_body_read(shared: Service) -> None:
    at = place(shared, limits=Limits(body_bytes=1_000), **OPEN)
    problem(at.client().post("/api/v1/plans", content=b"x" * 100_000), 401)


def nested(depth: int) -> list[bytes]:
    return [
        b"[" * depth + b"]" * depth,
        b'{"a":' * depth + b"1" + b"}" * depth,
        b'{"spec": ' + b"[{}," * (depth - 1) + b"1",
        b'{"]]]]}}}": ' + b'["}]\\"]",' * depth,
    ]


@pytest.mark.parametrize("body", nested(MAX_JSON_DEPTH + 1) + nested(100_000))
def test_a_body_that_is_nested_too_deep_is_refused(shared: Service, body: bytes) -> None:
    found = problem(place(shared).client().post("/api/v1/plans", content=body), 422)
    assert f"more than {MAX_JSON_DEPTH} deep" in found["detail"]


@pytest.mark.parametrize(
    "body",
    [
        b'{"preset": "cartpole-ppo", "note": "' + b"[{" * 500 + b'"}',
        b'{"preset": "cartpole-ppo", "note": "' + b'\\"[' * 500 + b'"}',
        b'{"preset": "cartpole-ppo", "tags": [' + b",".join([b'"]["'] * 20) + b"]}",
    ],
)
def test_brackets_in_texts_and_side_by_side_are_no_nesting(shared: Service, body: bytes) -> None:
    client = place(shared).client(content_type="application/json")
    assert client.post("/api/v1/plans", content=body).status_code == 200


def test_a_text_without_an_end_is_read_in_one_go(shared: Service) -> None:
    at = place(shared)
    # Where the time grew with the square, these would take minutes.
    for body in (b'[{"' + b'\\"' * 400_000, b"[{" * 50 + b'"' * 900_000, b"[{" * 50 + b'"\\' * 400_000):
        assert at.client().post("/api/v1/plans", content=body).status_code == 422


async def asked(
    app: Any, scope_changes: dict[str, Any], messages: list[Message], wait_s: float = 30.0
) -> list[Message]:
    """What an application sends, where the client's messages are given; after the last one nothing comes."""
    sent: list[Message] = []
    left = list(messages)

    async def receive() -> Message:
        if left:
            return left.pop(0)
        await anyio.sleep_forever()
        raise AssertionError

    async def send(message: Message) -> None:
        sent.append(message)

    scope: dict[str, Any] = {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "POST", "path": "/api/v1/plans",
        "raw_path": b"/api/v1/plans", "query_string": b"", "root_path": "", "scheme": "http",
        "headers": [(b"host", b"127.0.0.1:8265")], "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 8265),
    }  # fmt: skip
    with anyio.move_on_after(30):
        await app(scope | scope_changes, receive, send)
    return sent


def test_a_body_that_does_not_arrive_is_waited_for_a_while(shared: Service) -> None:
    at = place(shared, limits=Limits(body_s=0.05))
    part: Message = {"type": "http.request", "body": b'{"preset": ', "more_body": True}
    sent = anyio.run(asked, at.app, {}, [part])
    assert sent[0]["status"] == 408
    assert (b"connection", b"close") in sent[0]["headers"]


def test_a_client_that_leaves_half_way_is_forgotten(shared: Service) -> None:
    at = place(shared)
    part: Message = {"type": "http.request", "body": b'{"preset": "cartpole-ppo"}', "more_body": True}
    scope = {"path": "/api/v1/sweeps", "raw_path": b"/api/v1/sweeps"}
    assert anyio.run(asked, at.app, scope, [part, {"type": "http.disconnect"}]) == []
    assert shared.queue.jobs() == []


# -- answers


def test_every_answer_says_what_browsers_are_to_refuse(shared: Service) -> None:
    at = place(shared)
    client = at.client()
    for answer in (
        client.get("/healthz"), client.get(ME), client.get("/nowhere"), client.get(ME, headers=bearer("x")),
        client.get(ME, headers={"Host": "evil.example"}), client.post("/api/v1/plans", content=b"["),
    ):  # fmt: skip
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "same-origin"
        assert answer.headers["cross-origin-resource-policy"] == "same-origin"
        assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
    assert client.get(ME).headers["cache-control"] == "no-store"


def test_an_unexpected_error_is_answered_within_the_layer(shared: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(shared.statuses), "see", lambda *_: 1 / 0)
    answer = place(shared).client().get(f"/api/v1/sweeps/{SWEEP}")
    assert "ZeroDivisionError" in problem(answer, 500)["detail"]
    assert answer.headers["x-content-type-options"] == "nosniff"


def layer(at: Place, app: Any) -> TestClient:
    """A client of another application in the same layer."""
    return TestClient(AccessMiddleware(app, at.service.gate), URL)


def answering(headers: list[tuple[bytes, bytes]]) -> Any:
    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": b"<p>"})

    return app


def test_a_page_has_its_policy_and_a_route_may_set_its_own(shared: Service) -> None:
    at = place(shared)
    html = (b"content-type", b"text/html; charset=utf-8")
    policy = layer(at, answering([html])).get("/").headers["content-security-policy"].split("; ")
    assert set(policy) == {
        "default-src 'self'", "img-src 'self' data: blob:", "style-src 'self'", "script-src 'self'",
        "object-src 'none'", "base-uri 'none'", "frame-ancestors 'none'", "form-action 'self'",
    }  # fmt: skip
    own = layer(at, answering([html, (b"content-security-policy", b"sandbox")])).get("/")
    assert own.headers.get_list("content-security-policy") == ["sandbox"]


def test_a_stream_passes_part_by_part(shared: Service) -> None:
    """The first part arrives while the second is not there; a layer that gathered them would hang here."""
    at, seen = place(shared), anyio.Event()

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"a", "more_body": True})
        await seen.wait()
        await send({"type": "http.response.body", "body": b"b"})

    async def ask() -> list[bytes]:
        bodies: list[bytes] = []

        async def send(message: Message) -> None:
            if message["type"] == "http.response.body":
                bodies.append(message["body"])
                seen.set()

        async def receive() -> Message:
            return {"type": "http.request", "body": b"", "more_body": False}

        scope = {
            "type": "http", "method": "GET", "path": ME, "scheme": "http", "server": ("127.0.0.1", 8265),
            "headers": [(b"host", b"127.0.0.1:8265")], "client": ("127.0.0.1", 1),
        }  # fmt: skip
        with anyio.fail_after(30):
            await AccessMiddleware(app, at.service.gate)(scope, receive, send)
        return bodies

    assert anyio.run(ask) == [b"a", b"b"]


def test_websockets_pass_the_same_checks(shared: Service) -> None:
    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "websocket.accept"})
        await send({"type": "websocket.send", "text": scope["state"]["caller"].name})
        await send({"type": "websocket.close"})

    at = place(shared, **OPEN)
    client, secret = layer(at, app), at.token("viewer", "vera")
    cookie = {"Cookie": f"tune-jobs-8265={secret}"}
    for headers in (bearer(secret), cookie | {"Origin": URL}):
        with client.websocket_connect("ws://127.0.0.1:8265/api/v1/x", headers=headers) as socket:
            assert socket.receive_text() == "vera"
    refused: list[dict[str, str]] = [
        {},
        bearer("x"),
        cookie,
        cookie | {"Origin": "http://evil.example"},
        bearer(secret) | {"Host": "evil.example"},
    ]
    for headers in refused:
        with (
            pytest.raises((WebSocketDisconnect, WebSocketDenialResponse)),
            client.websocket_connect("ws://127.0.0.1:8265/api/v1/x", headers=headers),
        ):
            pass

"""Who asks: logging in, tokens that end, and what is written down of it."""

import json
from typing import Any

import anyio
import pytest
from service_access import OPEN, SWEEP, URL, Place, bearer, place, problem, shared  # noqa: F401 (fixture)
from sqlalchemy.exc import OperationalError
from starlette.types import Message, Receive, Scope, Send

from tune_jobs.service.access.middleware import AccessMiddleware
from tune_jobs.service.service import Service

# ruff: noqa: F811 - fixtures are named as arguments

ME = "/api/v1/me"


# -- logging in


def test_logging_in_and_out(shared: Service) -> None:
    at = place(shared, **OPEN)
    client = at.client(origin=URL)
    problem(client.get(ME), 401)
    answer = client.post("/api/v1/login", json={"token": at.token("submitter", "ann", days=2.0)})
    assert answer.json() == {"name": "ann", "role": "submitter"}
    cookie = answer.headers["set-cookie"].split("; ")
    assert {part.partition("=")[0] for part in cookie} == {"tune-jobs-8265", "HttpOnly", "Max-Age", "Path", "SameSite"}
    assert {"SameSite=Strict", "Path=/", f"Max-Age={2 * 86_400}"} <= set(cookie)
    assert client.get(ME).json()["name"] == "ann"
    assert client.post("/api/v1/plans", json={"preset": "cartpole-ppo"}).status_code == 200
    out = client.post("/api/v1/logout")
    assert out.status_code == 204
    assert "Max-Age=0" in out.headers["set-cookie"]
    problem(client.get(ME), 401)


def test_a_cookie_of_a_safe_connection_is_for_safe_ones_alone(shared: Service) -> None:
    at = place(shared, **OPEN)
    client = at.client("https://127.0.0.1:8265", origin="https://127.0.0.1:8265")
    cookie = client.post("/api/v1/login", json={"token": at.token("viewer")}).headers["set-cookie"]
    assert cookie.startswith("__Host-tune-jobs-8265=")
    assert "Secure" in cookie.split("; ")
    assert client.get(ME).status_code == 200


def test_a_cookie_that_opens_nothing_any_more_is_taken_away(shared: Service) -> None:
    at = place(shared, **OPEN)
    answer = at.client().get(ME, headers={"Cookie": f"tune-jobs-8265={at.revoked('viewer')}"})
    problem(answer, 401)
    assert "Max-Age=0" in answer.headers["set-cookie"]


def test_cookies_of_other_services_on_this_machine_are_not_ours(shared: Service) -> None:
    headers = {"Cookie": "tune-jobs-9000=x; other=y; tune-jobs=z"}
    assert place(shared).client().get(ME, headers=headers).status_code == 200


def test_the_pages_changes_come_from_the_page(shared: Service) -> None:
    at = place(shared, **OPEN)
    secret = at.token("submitter")

    def status(method: str, path: str, headers: dict[str, str]) -> int:
        return int(at.client().request(method, path, headers=headers, json={"preset": "cartpole-ppo"}).status_code)

    cookie = {"Cookie": f"tune-jobs-8265={secret}"}
    assert status("POST", "/api/v1/plans", cookie) == 403
    assert status("POST", "/api/v1/plans", cookie | {"Sec-Fetch-Site": "none"}) == 403
    assert status("POST", "/api/v1/plans", cookie | {"Sec-Fetch-Site": "same-site"}) == 403
    assert status("POST", "/api/v1/plans", cookie | {"Origin": "http://localhost:8265"}) == 403
    assert status("POST", "/api/v1/plans", cookie | {"Origin": "null"}) == 403
    assert status("POST", "/api/v1/plans", cookie | {"Origin": URL}) == 200
    assert status("POST", "/api/v1/plans", cookie | {"Sec-Fetch-Site": "same-origin"}) == 200
    assert status("POST", "/api/v1/plans", bearer(secret)) == 200
    assert status("GET", ME, cookie) == 200


def test_a_token_that_is_over_logs_nobody_in(shared: Service) -> None:
    at = place(shared, **OPEN)
    for secret in (at.expired("admin"), at.revoked("admin"), "x"):
        answer = at.client().post("/api/v1/login", json={"token": secret})
        problem(answer, 401)
        assert "set-cookie" not in answer.headers


def test_failed_logins_are_limited_by_client(shared: Service) -> None:
    at = place(shared, **OPEN)
    right, address = at.token("viewer"), "192.0.2.10"

    def login(token: str, client: str = address) -> Any:
        return at.client(address=client).post("/api/v1/login", json={"token": token})

    for number in range(10):
        at.clock.s += 1
        problem(login(f"wrong-{number}"), 401)
    refused = login(right)
    problem(refused, 429)
    assert refused.headers["retry-after"] == "51"
    problem(at.client(address=address).get(ME, headers=bearer("wrong")), 429)
    assert login(at.token("viewer"), "192.0.2.11").status_code == 200
    at.clock.s += 50
    problem(login(right), 429)
    at.clock.s += 1
    assert login(right).status_code == 200


def test_of_version_6_a_client_is_a_network(shared: Service) -> None:
    at = place(shared, limit=3, **OPEN)
    for number in range(3):
        problem(at.client(address=f"2001:db8::{number}").get(ME, headers=bearer("x")), 401)
    problem(at.client(address="2001:db8::ffff").get(ME, headers=bearer("x")), 429)
    problem(at.client(address="2001:db8:0:1::1").get(ME, headers=bearer("x")), 401)
    for number in range(3):
        problem(at.client(address="::ffff:192.0.2.1").get(ME, headers=bearer(f"{number}")), 401)
    problem(at.client(address="192.0.2.1").get(ME, headers=bearer("x")), 429)
    problem(at.client(address="::ffff:192.0.2.2").get(ME, headers=bearer("x")), 401)


def test_others_mistakes_and_old_tokens_lock_nobody_out(shared: Service) -> None:
    at = place(shared, limit=3, **OPEN)
    known, late = bearer(at.token("viewer")), bearer(at.expired("viewer"))
    assert at.client().get(ME, headers=known).status_code == 200
    for _ in range(5):
        problem(at.client().get(ME, headers=late), 401)
    for _ in range(3):
        problem(at.client().get(ME, headers=bearer("x")), 401)
    at.clock.s += 10
    assert at.client().get(ME, headers=known).status_code == 200
    problem(at.client().get(ME, headers=bearer("x")), 429)


# -- tokens that end


def test_a_revoked_token_opens_nothing_within_seconds(shared: Service) -> None:
    at, other = place(shared, **OPEN), place(shared, **OPEN)
    token, secret = at.service.gate.tokens.make("ann", "viewer")
    client = at.client(**bearer(secret))
    assert client.get(ME).status_code == 200
    # By a command, which is another process.
    other.service.gate.tokens.revoke(token.id)
    at.clock.s += 2.0
    problem(client.get(ME), 401)


async def stream_until_revoked(at: Place, secret: str, token_id: str) -> tuple[list[Message], bool]:
    """What a client of a stream gets whose token is revoked after the second part, and whether the stream was ended."""
    sent: list[Message] = []
    was_ended = False

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        nonlocal was_ended
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-type", b"text/event-stream")]})
        try:
            for number in range(5):
                await send({"type": "http.response.body", "body": b"%d" % number, "more_body": True})
                if number == 1:
                    # By a command, which is another process.
                    place(at.service, **OPEN).service.gate.tokens.revoke(token_id)
                at.clock.s += 2.0
        except anyio.get_cancelled_exc_class():
            was_ended = True
            raise

    async def receive() -> Message:
        await anyio.sleep_forever()
        raise AssertionError

    async def send(message: Message) -> None:
        sent.append(message)

    scope = {
        "type": "http", "method": "GET", "path": ME, "scheme": "http", "server": ("127.0.0.1", 8265),
        "headers": [(b"host", b"127.0.0.1:8265"), (b"authorization", f"Bearer {secret}".encode())],
        "client": ("127.0.0.1", 1),
    }  # fmt: skip
    with anyio.fail_after(30):
        await AccessMiddleware(app, at.service.gate)(scope, receive, send)
    return sent, was_ended


def test_a_stream_ends_with_its_token(shared: Service) -> None:
    at = place(shared, **OPEN)
    token, secret = at.service.gate.tokens.make("ann", "viewer")
    sent, was_ended = anyio.run(stream_until_revoked, at, secret, token.id)
    assert [message.get("body") for message in sent] == [None, b"0", b"1", b""]
    assert not sent[-1]["more_body"]
    assert was_ended


def test_a_token_expires_to_the_second(shared: Service) -> None:
    at = place(shared, **OPEN)
    client = at.client(**bearer(at.token("viewer", days=1.0)))
    at.clock.s += 86_399.5
    assert client.get(ME).status_code == 200
    at.clock.s += 0.5
    problem(client.get(ME), 401)


def test_a_database_that_is_gone_lets_nobody_in(shared: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    at = place(shared, **OPEN)
    secret = at.token("viewer")

    def fail(*_: object) -> None:
        raise OperationalError("SELECT", {}, Exception("gone"))

    monkeypatch.setattr(at.service.gate.tokens, "find", fail)
    answer = at.client(**bearer(secret)).get(ME)
    problem(answer, 503)
    assert answer.headers["retry-after"] == "5"


# -- the audit log


def test_each_change_is_written_down(shared: Service) -> None:
    at = place(shared, **OPEN)
    admin, secret = bearer(at.token("admin", "root")), at.token("submitter", "ann")
    client = at.client(address="192.0.2.20", **bearer(secret))
    client.patch(f"/api/v1/sweeps/{SWEEP}", json={"note": "x"})
    client.post("/api/v1/sweeps/none/stop")
    client.post("/api/v1/nowhere")
    client.post("/api/v1/plans", content=b"{")
    client.get("/api/v1/sweeps")
    at.client(address="192.0.2.20").post("/api/v1/login", json={"token": secret})
    at.client(address="192.0.2.20").post("/api/v1/login", json={"token": "wrong"})
    at.client(address="192.0.2.20", **bearer("wrong")).get("/api/v1/sweeps")
    at.client(address="192.0.2.20").post("/api/v1/sweeps", json={})
    page = at.client(**admin).get("/api/v1/audit", params={"limit": 7}).json()
    told = [(entry["who"], entry["action"], entry["target"], entry["status"]) for entry in reversed(page["entries"])]
    assert told == [
        ("ann", "change", SWEEP, 403), ("ann", "stop", "none", 403), ("ann", "POST no route", "", 404),
        ("ann", "plan", "", 422), ("ann", "login", "", 200), ("", "login", "", 401), ("", "login", "", 401),
    ]  # fmt: skip
    assert {entry["client"] for entry in page["entries"]} == {"192.0.2.20"}
    assert {entry["at"] for entry in page["entries"]} == {at.clock.s}
    assert all(secret not in json.dumps(entry) for entry in page["entries"])
    mine = at.client(**admin).get("/api/v1/audit", params={"who": "ann", "target": SWEEP}).json()["entries"]
    assert [entry["action"] for entry in mine] == ["change"]


def test_a_submission_is_written_down_with_its_sweep(shared: Service) -> None:
    at = place(shared)
    found = at.client().post("/api/v1/sweeps", json={"preset": "cartpole-ppo", "name": "made"})
    assert found.status_code == 201, found.text
    client = at.client()
    assert client.post("/api/v1/sweeps/made/stop").status_code == 202
    assert client.delete("/api/v1/sweeps/made", params={"force": True}).status_code == 204
    told = [(entry.who, entry.action, entry.target, entry.status) for entry in reversed(at.audited(3))]
    assert told == [
        ("local", "submit", "made", 201), ("local", "stop", "made", 202), ("local", "delete", "made", 204)
    ]  # fmt: skip


def test_what_nobody_in_particular_asks_does_not_fill_the_log(shared: Service) -> None:
    at = place(shared, limit=3, **OPEN)
    before = at.audited()[0].id if at.audited() else 0
    late = bearer(at.expired("admin"))
    for _ in range(20):
        at.client().post("/api/v1/sweeps", json={})
        at.client().post("/api/v1/login", json={"token": "x"})
        at.client().post("/api/v1/login", json={"wrong": "x"})
        at.client().post("/api/v1/nowhere", headers=bearer("x"))
        at.client().post("/api/v1/nowhere", headers=late)
    assert at.audited()[0].id - before <= 3 + 1


def test_an_audit_log_that_cannot_be_written_stops_nothing(
    shared: Service, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    at = place(shared)

    class Gone:
        def begin(self) -> None:
            raise OperationalError("INSERT", {}, Exception("disk full"))

    monkeypatch.setattr(at.service.gate.audit, "_engine", Gone())
    assert at.client().post("/api/v1/plans", json={"preset": "cartpole-ppo"}).status_code == 200
    assert "'action': 'plan'" in caplog.text

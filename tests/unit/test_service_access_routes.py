"""Every route with every kind of caller: one that forgets its guard is found here."""

import re
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from service_access import OPEN, SWEEP, bearer, place, problem, raw_answer, shared, status_of  # noqa: F401 (fixture)

from tune_jobs.service.service import Service

# ruff: noqa: F811 - fixtures are named as arguments

METHODS = ("GET", "HEAD", "OPTIONS", "POST", "PUT", "PATCH", "DELETE")
CHANGING = ("POST", "PUT", "PATCH", "DELETE")
PUBLIC = {"/", "/static/{path:path}", "/healthz", "/readyz", "/api/v1/login"}
"""What needs no token: it shows nothing of a sweep and changes none."""
EVERYBODYS = {"/api/v1/login", "/api/v1/logout"}
"""What changes something, and is a viewer's, too."""
ADMINS = {"/api/v1/audit"}
"""What only admins see."""
VALUES = {"film": "after_mp4", "file": "policy.json", "name": SWEEP, "trial_id": "t0000"}


def routes_of(app: FastAPI) -> list[tuple[str, str]]:
    """All methods of all routes, with the paths as they are declared."""
    found = []
    for context in iter_route_contexts(app.routes):
        # A route of another kind, such as a mounted folder, needs a thought here about who may use it.
        assert context.path is not None, context
        assert context.methods, context
        found += [(method, context.path) for method in sorted(context.methods)]
    assert len(found) > 20
    return found


def filled(path: str) -> str:
    """A path with values for its parameters, of which the sweep exists."""
    return re.sub(r"\{(\w+)(?::\w+)?\}", lambda found: VALUES.get(found[1], "1"), path)


def test_without_a_valid_token_every_route_and_method_is_closed(shared: Service) -> None:
    at = place(shared, limit=10**9, **OPEN)
    wrong = "tune-jobs_00000000_" + "A" * 43
    cookie = "tune-jobs-8265"
    shown: dict[str, dict[str, str]] = {
        "none": {}, "wrong": bearer(wrong), "expired": bearer(at.expired("admin")),
        "revoked": bearer(at.revoked("admin")), "no token at all": bearer("x"), "empty": {"Authorization": "Bearer"},
        "another scheme": {"Authorization": "Basic YTpi"}, "a wrong cookie": {"Cookie": f"{cookie}={wrong}"},
        "an expired cookie": {"Cookie": f"a=b; {cookie}={at.expired('admin')}"},
    }  # fmt: skip
    opened = {
        (method, path, kind)
        for path in {path for _, path in routes_of(at.app)} | {"/nowhere", "/api/v1/nowhere", "/metrics"}
        for method in METHODS
        for kind, headers in shown.items()
        if path not in PUBLIC and status_of(at.app, method, filled(path), headers) != 401
    }
    assert opened == set()


def test_what_needs_no_token_needs_none(shared: Service) -> None:
    at = place(shared, **OPEN)
    for path in PUBLIC & {path for _, path in routes_of(at.app)} - EVERYBODYS:
        assert status_of(at.app, "GET", filled(path), {}) in (200, 404, 503), path


def test_a_viewer_looks_and_changes_nothing(shared: Service) -> None:
    at = place(shared, **OPEN)
    headers = bearer(at.token("viewer"))
    before = shared.storage.sweep(SWEEP).read_record()
    for method, path in routes_of(at.app):
        status = status_of(at.app, method, filled(path), headers)
        if (method in CHANGING and path not in EVERYBODYS) or path in ADMINS:
            assert status == 403, (method, path, status)
        elif method in ("GET", "HEAD"):
            # Not there (of a made up trial, say), without its query, or not ready as the queue stands still.
            assert status in (200, 206, 404, 422, 503), (method, path, status)
    assert shared.storage.sweep(SWEEP).read_record() == before
    assert shared.queue.jobs() == []


def test_a_submitter_changes_no_sweep_of_others(shared: Service) -> None:
    at = place(shared, **OPEN)
    headers = bearer(at.token("submitter"))
    own = 0
    for method, path in routes_of(at.app):
        if method in CHANGING and "{name}" in path:
            assert status_of(at.app, method, filled(path), headers) == 403, (method, path)
            own += 1
        if path in ADMINS:
            assert status_of(at.app, method, filled(path), headers) == 403, (method, path)
    assert own >= 7


def test_a_submitter_changes_an_own_sweep(shared: Service) -> None:
    at = place(shared, **OPEN)
    shared.labels.change(SWEEP, owner="ann")
    try:
        for name, status in (("ann", 200), ("bob", 403)):
            client = at.client(**bearer(at.token("submitter", name)))
            assert client.patch(f"/api/v1/sweeps/{SWEEP}", json={"note": name}).status_code == status
        assert shared.labels.of(SWEEP).note == "ann"
    finally:
        shared.labels.forget(SWEEP)


def test_the_openapi_document_says_what_needs_a_token(shared: Service) -> None:
    document = place(shared).client().get("/api/v1/openapi.json").json()
    schemes = document["components"]["securitySchemes"]
    assert {name for item in document["security"] for name in item} == set(schemes) == {"token", "cookie"}
    unguarded = {
        path for path, methods in document["paths"].items() for said in methods.values() if said.get("security") == []
    }
    assert unguarded == PUBLIC & document["paths"].keys()


def test_who_asks_is_said(shared: Service) -> None:
    at = place(shared, **OPEN)
    assert at.client(**bearer(at.token("viewer", "vera"))).get("/api/v1/me").json()["role"] == "viewer"
    here = place(shared)
    assert here.client().get("/api/v1/me").json()["name"] == "local"
    assert here.client(**bearer(here.token("viewer", "vera"))).get("/api/v1/me").json()["name"] == "vera"


def test_a_token_that_is_shown_counts_on_this_machine_too(shared: Service) -> None:
    at = place(shared)
    for secret in ("x", at.expired("admin"), at.revoked("admin")):
        problem(at.client(**bearer(secret)).get("/api/v1/me"), 401)
    assert at.client(**bearer(at.token("viewer"))).delete(f"/api/v1/sweeps/{SWEEP}").status_code == 403


@pytest.mark.parametrize(
    "settings",
    [
        {"require_token": True}, {"behind_proxy": "loopback"}, {"public_names": ("tune.example.org",)},
        {"host": "192.0.2.1"}, {"host": "::"},
    ],
)  # fmt: skip
def test_a_token_is_needed_wherever_others_could_come_in(shared: Service, settings: dict[str, Any]) -> None:
    at = place(shared, **settings)
    found = problem(at.client().get("/api/v1/sweeps"), 401)
    assert "tune-jobs token make" in found["hint"]
    assert at.client().get("/api/v1/sweeps").headers["WWW-Authenticate"].startswith("Bearer")


@pytest.mark.parametrize("name", ["X-Forwarded-For", "Forwarded", "X-Real-IP", "Via", "X-Forwarded-Host"])
def test_what_a_proxy_passes_on_unannounced_is_not_this_machines(shared: Service, name: str) -> None:
    problem(place(shared).client().get("/api/v1/sweeps", headers={name: "192.0.2.1"}), 401)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1", "127.0.0.2"])
@pytest.mark.parametrize("names", [(), ("localhost:9000", "[::1]")])
def test_this_machine_needs_no_token(shared: Service, host: str, names: tuple[str, ...]) -> None:
    assert place(shared, host=host, public_names=names).client().get("/api/v1/sweeps").status_code == 200


# -- paths and texts that lead elsewhere

ELSEWHERE = [
    "..", "%2e%2e", "..%2f..%2f..%2fetc%2fpasswd", "..%5c..%5cetc%5cpasswd", "%2e%2e%2f", "%2fetc%2fpasswd",
    "..%252f..%252fetc%252fpasswd", "%00", "done%00", "done%2f..%2fdone", "./done", "done%2f", ".service", "c:%5cw",
    ".service%2fservice.db", "%c0%ae%c0%ae%c0%af", "%ff%fe", "file:%2f%2f%2fetc%2fpasswd", "~", "~root", "$HOME", "*",
    "d%6fne%20", "done.", "%0d%0aSet-Cookie:%20a=b", "a" * 300, "%f0%9f%92%a9" * 64, "done;id", "|id", "`id`", "-rf",
    "%3cscript%3e", "CON", "%e2%80%ae", "%ed%a0%80",
]  # fmt: skip


@pytest.mark.parametrize("value", ELSEWHERE)
def test_no_parameter_of_a_path_leads_elsewhere(shared: Service, value: str) -> None:
    at = place(shared)
    before = {path: path.read_bytes() for path in Path(shared.config.storage).rglob("*.json")}
    for method, path in routes_of(at.app):
        for parameter in re.findall(r"\{(\w+)(?::\w+)?\}", path):
            asked = filled(re.sub(rf"\{{{parameter}(?::\w+)?\}}", lambda _: value, path))
            answer = raw_answer(at.app, method, asked)
            # Without a slash at its end a path may be one, which the client is told.
            assert answer.status in (307, 404, 405, 422), (method, asked, answer)
            assert b"root:" not in answer.body
            assert not any(name.lower() == b"set-cookie" for name, _ in answer.headers)
    assert {path: path.read_bytes() for path in Path(shared.config.storage).rglob("*.json")} == before


MARKUP = '<script>alert(1)</script><img src=x onerror="alert(1)">'


def test_markup_stays_a_text(shared: Service) -> None:
    at = place(shared)
    client = at.client()
    try:
        said = client.patch(f"/api/v1/sweeps/{SWEEP}", json={"note": MARKUP, "tags": ["<b>"]})
        answers = [
            said,
            client.get(f"/api/v1/sweeps/{MARKUP.replace('/', '')}"),
            client.get("/api/v1/sweeps", params={"sort": MARKUP}),
            client.post("/api/v1/sweeps", json={"preset": MARKUP}),
            client.post("/api/v1/sweeps", json={MARKUP: 1}),
            client.post("/api/v1/sweeps", json={"preset": "cartpole-ppo", "name": "<b>"}),
            client.get("/" + MARKUP),
            client.get("/api/v1/me", headers={"Host": "<script>"}),
            client.get("/api/v1/me", headers={"Origin": MARKUP}),
        ]
    finally:
        shared.labels.forget(SWEEP)
    assert said.json()["note"] == MARKUP
    for answer in answers:
        assert answer.headers["content-type"] in ("application/json", "application/problem+json"), answer.text
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert "script-src" not in answer.headers["content-security-policy"]
        assert answer.headers["content-security-policy"].startswith("default-src 'none'")
    assert shared.queue.jobs() == []

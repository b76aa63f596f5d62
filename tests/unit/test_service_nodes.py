"""Sweeps of a service that may wait for nodes of its cluster: who says how long, and what is refused."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fake_sweeps import RunCommand
from fastapi.testclient import TestClient
from live_service import Live, live  # noqa: F401 (a fixture)
from services import FAKE, client, service  # noqa: F401 (fixtures)
from sweep_folders import make_sweep_folder

from policies.errors import SpecError
from tune_jobs.cli import remote_runs
from tune_jobs.client import Client
from tune_jobs.service import driver
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.database.opening import sqlite_url
from tune_jobs.service.job_files import JobFiles
from tune_jobs.service.jobs import Job
from tune_jobs.service.service import Service

# ruff: noqa: F811 - fixtures are named as arguments

SWEEPS = "/api/v1/sweeps"


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """One kind of database is enough here."""
    return sqlite_url(tmp_path / "service.db")


def on_a_cluster(service: Service) -> None:
    object.__setattr__(service.config, "address", "auto")


def given_to_the_driver(service: Service, job: Job, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What a driver is told of a job."""
    given: list[dict[str, Any]] = []
    fake: Any = SimpleNamespace(pid=0, give=lambda request, lock, log: given.append(request))
    monkeypatch.setattr(service.supervisor, "_driver", lambda: fake)
    service.supervisor._give(job, JobFiles(service.config.folder, job.uid))
    return given[0]


def test_a_request_says_how_long_and_else_the_operator_does(
    client: TestClient, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_a_cluster(service)
    object.__setattr__(service.supervisor._where, "wait_for_nodes", 600.0)
    for wait, waits in ((60, 60.0), (0, 0.0), (None, 600.0)):
        answer = client.post(SWEEPS, json={"spec": FAKE, "wait_for_nodes": wait})
        assert answer.status_code == 201, answer.text
        job = service.queue.job(answer.json()["job"]["id"])
        assert given_to_the_driver(service, job, monkeypatch)["wait_for_nodes"] == waits
    [first, *_] = service.queue.jobs()
    assert first.arguments == {"wait_for_nodes": 60.0}


@pytest.mark.parametrize(
    ("verb", "body"),
    [("resume", None), ("extend", {"num_samples": 1}), ("trials", {"point": {"lr": 5e-3}}), ("replicate", {"top": 2})],
)
def test_so_does_whatever_runs_trials(
    client: TestClient, service: Service, verb: str, body: dict[str, Any] | None
) -> None:
    on_a_cluster(service)
    make_sweep_folder(Path(service.config.place) / "mine")
    at = f"{SWEEPS}/mine/{verb}"
    answer = client.post(at, json=body, params={"wait_for_nodes": 60})
    assert answer.status_code == 202, answer.text
    assert answer.json()["arguments"]["wait_for_nodes"] == 60.0
    if verb == "resume":
        # How long it waits makes it no other job.
        assert client.post(at, params={"wait_for_nodes": 90}).status_code == 409


@pytest.mark.parametrize("wait", [-1, 1e10, "60", "long", True, [60]])
def test_what_is_no_number_of_seconds_is_refused(client: TestClient, service: Service, wait: Any) -> None:
    on_a_cluster(service)
    answer = client.post(SWEEPS, json={"spec": FAKE, "wait_for_nodes": wait})
    assert answer.status_code == 422
    assert answer.json()["problems"][0]["path"] == "body.wait_for_nodes"
    make_sweep_folder(Path(service.config.place) / "mine")
    for text in ("-1", "long", "nan", "inf", "1e10"):
        answer = client.post(f"{SWEEPS}/mine/resume", params={"wait_for_nodes": text})
        assert answer.status_code == 422, text
    assert service.queue.jobs() == []


def test_where_no_node_joins_there_is_nothing_to_wait_for(client: TestClient, service: Service, tmp_path: Path) -> None:
    answer = client.post(SWEEPS, json={"spec": FAKE, "name": "mine", "wait_for_nodes": 60})
    assert answer.status_code == 422
    assert "this service runs sweeps on its own machine" in answer.json()["detail"]
    make_sweep_folder(Path(service.config.place) / "there")
    assert client.post(f"{SWEEPS}/there/resume", params={"wait_for_nodes": 60}).status_code == 422
    assert service.queue.jobs() == []
    assert not (Path(service.config.place) / "mine").exists()
    # Not to wait is what it does anyway.
    assert client.post(SWEEPS, json={"spec": FAKE, "wait_for_nodes": 0}).status_code == 201
    with pytest.raises(SpecError, match="no address names one"):
        ServiceConfig(storage=tmp_path, wait_for_nodes=60)


@pytest.mark.parametrize("verb", ["drive", "extend", "inject", "replicate", "retry"])
def test_the_driver_waits_so_long(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, verb: str) -> None:
    waited: list[float] = []

    def note(*_: Any, wait_for_nodes: float, **__: Any) -> None:
        waited.append(wait_for_nodes)

    for name in ("resume", "extend", "inject", "replicate"):
        monkeypatch.setattr(f"tune_jobs.sweeps.verbs.{name}", note)
    place = str(make_sweep_folder(tmp_path / "mine").folder)
    arguments = {"to_num_samples": 90, "point": {"lr": 0.5}, "top": 2, "seeds": 1}
    request = {"sweep": place, "verb": verb, "arguments": arguments, "address": "auto", "job": "1"}
    driver._done({**request, "wait_for_nodes": 60.0})
    assert waited == [60.0]


def test_the_command_line_and_the_client_say_it(
    run: RunCommand, live: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "poles.yaml").write_text("env: CartPole-v1\nalgorithm: ppo\nspace: {lr: {grid: [1e-3, 2e-3]}}\n")
    words = ("--server", live.url, "launch", "poles.yaml", "--wait-for-nodes", "60")
    refused = run(*words)
    assert refused.exit_code == 2
    assert "this service runs sweeps on its own machine" in refused.stderr
    on_a_cluster(live.service)
    # Nobody runs it here.
    monkeypatch.setattr(remote_runs, "_followed", lambda client, job, say: job.model_copy(update={"outcome": "failed"}))
    assert "Sweep poles failed" in run(*words).stderr
    with Client(live.url) as client:
        client.submit(tmp_path / "poles.yaml", name="soon", wait_for_nodes=0)
        client.submit(tmp_path / "poles.yaml", name="said")
    assert [job.arguments for job in live.service.queue.jobs()] == [
        {"wait_for_nodes": 60.0},
        {"wait_for_nodes": 0.0},
        {},
    ]

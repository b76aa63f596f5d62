"""Actions on one sweep that come at once, or while a terminal runs it: each is done, and none is lost."""

import contextlib
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from services import client, service  # noqa: F401 (fixtures)
from sweep_folders import make_sweep_folder

from tune_jobs.service.database.opening import sqlite_url
from tune_jobs.service.service import Service
from tune_jobs.store.sweep_store import SweepStore

# ruff: noqa: F811 - fixtures are named as arguments

MINE = "/api/v1/sweeps/mine"
MEETING_S = 0.5


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """One kind of database is enough here."""
    return sqlite_url(tmp_path / "service.db")


@pytest.fixture
def store(service: Service) -> SweepStore:
    """A completed sweep of 2 points with 2 seeds each."""
    return make_sweep_folder(Path(service.config.storage) / "mine")


def both(client: TestClient, service: Service, monkeypatch: pytest.MonkeyPatch, verb: str, body: Any) -> list[Any]:
    """Send a request twice at once; each waits before it adds its job until the other one does, or for a while."""
    barrier, begin = threading.Barrier(2), service.queue.begin

    def begin_together(*arguments: Any, **named: Any) -> Any:
        with contextlib.suppress(threading.BrokenBarrierError):
            barrier.wait(MEETING_S)
        return begin(*arguments, **named)

    monkeypatch.setattr(service.queue, "begin", begin_together)
    with ThreadPoolExecutor(2) as pool:
        answers = list(pool.map(lambda _: client.post(f"{MINE}/{verb}", json=body), range(2)))
    return sorted(answers, key=lambda answer: answer.status_code)


# -- at once


def test_of_two_that_extend_it_both_do(
    client: TestClient, service: Service, store: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = both(client, service, monkeypatch, "extend", {"num_samples": 3})
    assert [answer.status_code for answer in answers] == [202, 202]
    assert sorted(answer.json()["arguments"]["to_num_samples"] for answer in answers) == [5, 8]


def test_two_together_stay_within_the_limits(
    client: TestClient, service: Service, store: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    object.__setattr__(service.config.limits, "trials", 10)
    answers = both(client, service, monkeypatch, "extend", {"num_samples": 3})
    assert [answer.status_code for answer in answers] == [202, 422]
    assert "would have 16 trials" in answers[1].json()["detail"]


@pytest.mark.parametrize("asked", [("resume", None), ("replicate", {"top": 2}), ("trials", {"point": {"lr": 5e-3}})])
def test_of_two_that_ask_for_the_same_one_is_told_so(
    client: TestClient, service: Service, store: SweepStore, monkeypatch: pytest.MonkeyPatch, asked: tuple[str, Any]
) -> None:
    answers = both(client, service, monkeypatch, *asked)
    assert [answer.status_code for answer in answers] == [202, 409]
    assert "has that job already" in answers[1].json()["detail"]
    assert len(service.queue.jobs()) == 1


def test_what_is_added_while_a_job_ends_is_counted_from_what_it_added(
    client: TestClient, service: Service, store: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = client.post(f"{MINE}/extend", json={"num_samples": 3}).json()
    jobs = service.queue.jobs

    def ends_then(*states: Any, **of: Any) -> Any:
        if service.queue.job(job["id"]).state != "ended":
            record = store.read_record()
            store.write_record(record.model_copy(update={"spec": record.spec | {"num_samples": 5}}))
            service.queue.end(job["id"], "completed")
        return jobs(*states, **of)

    monkeypatch.setattr(service.queue, "jobs", ends_then)
    assert client.post(f"{MINE}/extend", json={"num_samples": 3}).json()["arguments"] == {"to_num_samples": 8}


# -- while a terminal runs it


def test_a_stop_ends_what_a_terminal_runs_and_what_waits_for_it(
    client: TestClient, service: Service, store: SweepStore
) -> None:
    assert client.post(f"{MINE}/resume").status_code == 202
    with store.lock():
        answer = client.post(f"{MINE}/stop")
        assert answer.status_code == 202
        assert [job["outcome"] for job in answer.json()] == ["cancelled"]
        assert store.stop_requested()


def test_a_stop_of_what_the_service_runs_is_the_queues_alone(
    client: TestClient, service: Service, store: SweepStore
) -> None:
    client.post(f"{MINE}/resume")
    service.queue.claim(1.0)
    with store.lock():
        (job,) = client.post(f"{MINE}/stop").json()
        assert (job["state"], job["stop_requested"]) == ("running", True)
        # Its driver is asked where the queue is looked at.
        assert not store.stop_requested()


def test_a_stop_of_what_waits_leaves_no_request_behind(client: TestClient, store: SweepStore) -> None:
    client.post(f"{MINE}/resume")
    assert client.post(f"{MINE}/stop").status_code == 202
    assert not store.stop_requested()
    assert client.post(f"{MINE}/stop").status_code == 409

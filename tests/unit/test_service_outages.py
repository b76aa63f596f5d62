"""What fails for long is in the log once, then at growing intervals, and once when it works again."""

import itertools
import logging
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from services import client, service  # noqa: F401 (fixtures)
from sqlalchemy.exc import OperationalError

from tune_jobs.service import supervisor as module
from tune_jobs.service.database.opening import sqlite_url
from tune_jobs.service.outages import CALM_S, Outages
from tune_jobs.service.service import Service

# ruff: noqa: F811 - fixtures are named as arguments

QUEUE = "The queue can't be looked at"


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """One kind of database is enough here."""
    return sqlite_url(tmp_path / "service.db")


def away() -> OperationalError:
    return OperationalError("SELECT 1", {}, Exception("server closed\nthe connection"))


def told(caplog: pytest.LogCaptureFixture) -> list[str]:
    found = [record.getMessage() for record in caplog.records if record.name.endswith("outages")]
    caplog.clear()
    return found


def test_a_lost_database_is_told_at_growing_intervals(caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()
    outages = Outages(clock)
    at = []
    for _ in range(24 * 3_600):
        outages.failed(QUEUE, away())
        if told(caplog):
            at.append(clock.now - 100)
        clock.now += 1
    assert at[:7] == [0, 60, 180, 420, 900, 1_860, 3_780]
    assert {after - before for before, after in itertools.pairwise(at[6:])} == {3_600}
    # Others that use it have nothing to add.
    outages.failed("Messages can't be sent", away())
    assert told(caplog) == []


def test_it_is_told_once_that_it_works_again(caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()
    outages = Outages(clock)
    outages.worked(QUEUE)
    outages.failed(QUEUE, away())
    assert told(caplog) == [
        "The service's database can't be used: server closed the connection. It is tried again."
    ]  # fmt: skip
    clock.now += 2
    outages.failed("A request", away())
    # It may fail again at once.
    outages.worked(QUEUE)
    assert told(caplog) == []
    clock.now += CALM_S
    for _ in range(3):
        outages.worked(QUEUE)
    assert told(caplog) == ["It works again: The service's database can't be used, for 2 s (2 attempts)."]
    outages.failed(QUEUE, away())
    assert len(told(caplog)) == 1


def test_another_reason_is_told_with_its_traceback(caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()
    outages = Outages(clock)
    outages.failed(QUEUE, away())
    caplog.clear()
    outages.failed(QUEUE, ValueError("odd"))
    (record,) = caplog.records
    assert (record.getMessage(), bool(record.exc_info)) == (f"{QUEUE}. It is tried again.", True)
    clock.now += CALM_S
    caplog.clear()
    # That messages are sent says nothing of the queue.
    outages.worked("Messages can't be sent")
    assert told(caplog) == ["It works again: The service's database can't be used, for 0 s (1 attempts)."]
    outages.worked(QUEUE)
    assert told(caplog) == [f"It works again: {QUEUE}, for 0 s (1 attempts)."]


def test_queue_and_requests_tell_it_together(
    client: TestClient, service: Service, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object, **__: object) -> None:
        looked.append(1)
        if len(looked) == 5:
            service.supervisor._end.set()
        raise away()

    looked: list[int] = []
    monkeypatch.setattr(module, "TICK_S", 0.0)
    monkeypatch.setattr(service.queue, "jobs", broken)
    monkeypatch.setattr(service.supervisor, "_look", broken)
    service.supervisor._end.clear()
    monkeypatch.setattr(service.supervisor._end, "wait", lambda _: None)
    with caplog.at_level(logging.INFO):
        service.supervisor._run()
        assert client.get("/api/v1/jobs").status_code == 503
    assert len(told(caplog)) == 1
    assert len(looked) == 6

"""Submissions that are repeated or come at once: one sweep each, whose it is, and no more than somebody may have."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from services import FAKE, client, service  # noqa: F401 (fixtures)
from sqlalchemy.exc import OperationalError

from tune_jobs.service.database.opening import sqlite_url
from tune_jobs.service.http.models import NewSweep
from tune_jobs.service.service import Service

# ruff: noqa: F811 - fixtures are named as arguments

KEY = {"Idempotency-Key": "k"}


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """One kind of database is enough here."""
    return sqlite_url(tmp_path / "service.db")


def submit(client: TestClient, **options: Any) -> int:
    answer = client.post("/api/v1/sweeps", json={"spec": FAKE, "note": "mine", "tags": ["a"]}, **options)
    return answer.status_code


def test_who_has_as_many_as_may_be_hears_of_the_last_again(client: TestClient, service: Service) -> None:
    object.__setattr__(service.config.limits, "sweeps", 1)
    assert submit(client, headers=KEY) == 201
    # Its answer was lost, and it makes no second one.
    assert submit(client, headers=KEY) == 200
    assert submit(client) == 429
    assert len(service.queue.jobs()) == 1


def test_of_many_at_once_only_as_many_are_taken_as_may_be(
    client: TestClient, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    object.__setattr__(service.config.limits, "sweeps", 2)
    planned = service.submitter._planned(NewSweep(spec=FAKE).submission())
    monkeypatch.setattr(service.submitter, "_planned", lambda _: planned)
    with ThreadPoolExecutor(6) as pool:
        found = sorted(pool.map(lambda _: submit(client), range(6)))
    assert found == [201, 201, 429, 429, 429, 429]
    assert len(service.queue.jobs()) == 2


def test_a_sweep_whose_owner_could_not_be_written_has_one_once_it_is_asked_for_again(
    client: TestClient, service: Service
) -> None:
    def away(*_: Any, **__: Any) -> None:
        raise OperationalError("UPDATE", {}, Exception("server closed the connection"))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service.labels, "change", away)
        assert submit(client, headers=KEY) == 503
    assert submit(client, headers=KEY) == 200
    (job,) = service.queue.jobs()
    label = service.labels.of(job.sweep)
    assert (label.owner, label.note, label.tags) == (job.owner, "mine", ("a",))

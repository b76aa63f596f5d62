"""A sweep whose lock can't be read, such as one in a private folder: it is left alone, and hides and stops no other."""

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from services import client, service  # noqa: F401 (fixtures)
from sweep_folders import make_sweep_folder
from test_service_supervisor import Place, place  # noqa: F401 (a fixture)

from tests.narrowing import present
from tune_jobs.service.database.opening import sqlite_url
from tune_jobs.service.job_files import JobFiles
from tune_jobs.service.jobs import Job
from tune_jobs.service.service import Service
from tune_jobs.service.supervisor import Supervisor

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """One kind of database is enough here."""
    return sqlite_url(tmp_path / "service.db")


@pytest.fixture
def queue(place: Place) -> Iterator[Supervisor]:
    made = place.new_service()
    yield made
    made.close()


def close_lock(folder: Path) -> None:
    """Let nobody find out who drives a sweep, as in another one's private folder: root may read those."""
    lock = folder / ".lock"
    lock.unlink(missing_ok=True)
    lock.symlink_to("nothing")


def look_until_it_ends(place: Place, queue: Supervisor, job: Job) -> None:
    """Look at the queue again and again, as its thread does."""

    def has_ended() -> bool:
        queue._look()
        return place.queue.job(job.id).state == "ended"

    place.wait(has_ended, "it never ended")


def test_a_start_leaves_it_alone_and_begins_the_others(
    place: Place, queue: Supervisor, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("private", "waits"):
        place.add(name)
    close_lock(place.folder / "private")
    queue.start()
    assert [(job.sweep, job.outcome) for job in place.until_all_end()] == [("waits", "completed")]
    (said,) = [record.getMessage() for record in caplog.records if "private" in record.getMessage()]
    assert said.startswith("Sweep private is left alone: The sweep's lock ")


def test_a_job_that_waits_for_it_lets_the_others_run(
    place: Place, queue: Supervisor, caplog: pytest.LogCaptureFixture
) -> None:
    first, second = place.submit("private"), place.submit("other")
    close_lock(place.folder / "private")
    look_until_it_ends(place, queue, second)
    for _ in range(20):
        queue._look()
    assert place.queue.job(first.id).state == "waiting"
    (said,) = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert said.startswith("Sweep private can't be looked at: The sweep's lock ")
    assert said.endswith("it is a symbolic link. It is tried again.")
    (place.folder / "private" / ".lock").unlink()
    look_until_it_ends(place, queue, first)


def test_one_that_is_to_stop_lets_the_others_be_looked_at(place: Place, queue: Supervisor) -> None:
    for name in ("private", "other"):
        place.submit(name)
        present(place.queue.claim(2.0))
    runs, ends = place.queue.jobs("running")
    place.queue.request_stop("private")
    close_lock(place.folder / "private")
    # A driver lives; that of the other one is gone.
    lock = JobFiles(place.service_folder, runs.uid).take()
    assert lock is not None
    place.queue.request_stop("other")
    queue._look()
    assert [place.queue.job(job.id).state for job in (runs, ends)] == ["running", "ended"]


def test_lists_leave_it_out_and_it_says_what_is_wrong(
    client: TestClient, service: Service, caplog: pytest.LogCaptureFixture
) -> None:
    storage = Path(service.config.place)
    for name in ("mine", "private"):
        make_sweep_folder(storage / name)
    close_lock(storage / "private")
    assert [item["name"] for item in client.get("/api/v1/sweeps").json()["sweeps"]] == ["mine"]
    assert [item["sweep"]["name"] for item in client.get("/api/v1/statuses").json()["statuses"]] == ["mine"]
    assert "Left out: The sweep's lock " in caplog.text
    found = client.get("/api/v1/sweeps/private")
    assert found.status_code == 503
    assert "it is a symbolic link" in found.json()["detail"]

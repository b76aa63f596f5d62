"""What the service says when its disk, database or cluster fails; nothing is half-made then, and it stays up."""

import contextlib
import errno
import os
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from databases import PostgreSQL, started_or_skip
from fake_sweeps import RunCommand
from fastapi.testclient import TestClient
from service_access import bearer, no_space_for_tokens, place
from services import FAKE, client, service  # noqa: F401 (fixtures)
from sweep_folders import make_sweep_folder

from tune_jobs.service.access.tokens import FRESH_S
from tune_jobs.service.database import opening
from tune_jobs.service.database.opening import open_database, sqlite_url
from tune_jobs.service.driver import _ended
from tune_jobs.service.service import Service

# ruff: noqa: F811 - fixtures are named as arguments

WAITING_S = 0.3


@pytest.fixture
def database_url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The URL of a new SQLite database, for which nobody waits long."""
    monkeypatch.setattr(opening, "BUSY_TIMEOUT_S", WAITING_S)
    return sqlite_url(tmp_path / "database" / "service.db")


@pytest.fixture(autouse=True)
def folder_of_database(tmp_path: Path) -> Path:
    folder = tmp_path / "database"
    folder.mkdir()
    return folder


@pytest.fixture
def finished(service: Service) -> str:
    make_sweep_folder(Path(service.config.storage) / "done")
    return "done"


def problem(answer: Any, status: int) -> dict[str, Any]:
    """The problem document of an answer."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    found: dict[str, Any] = answer.json()
    assert found["detail"].endswith(".")
    return found


def submit(client: TestClient, **changes: Any) -> Any:
    return client.post("/api/v1/sweeps", json={"spec": FAKE, "name": "mine"} | changes)


def files_of(service: Service) -> set[str]:
    """What is in the storage folder, besides what the service itself writes there."""
    storage = Path(service.config.storage)
    return {str(path.relative_to(storage)) for path in storage.rglob("*") if ".service" not in path.parts}


# -- a disk that is full


def full(*_: Any, **__: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def after(number: int, original: Callable[..., Any]) -> Callable[..., Any]:
    """A function that works so often, and finds a full disk then."""
    left = iter(range(number))

    def call(*arguments: Any, **named: Any) -> Any:
        return original(*arguments, **named) if next(left, None) is not None else full()

    return call


@pytest.mark.parametrize("works", [0, 1, 4, 5])
def test_a_sweep_for_which_there_is_no_space_is_not_half_made(client: TestClient, service: Service, works: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        # Four trials and the sweep itself are written one after the other; folders before them.
        what = (Path, "mkdir") if works == 0 else (Path, "write_bytes")
        patch.setattr(*what, after(0 if works == 0 else works - 1, getattr(*what)))
        found = problem(submit(client), 507)
        assert "No space left on device" in found["detail"]
        assert "space" in found["hint"]
        assert client.get("/healthz").status_code == 200
    assert service.queue.jobs() == []
    assert files_of(service) == set()
    # The same request is taken when there is space.
    assert submit(client).status_code == 201


def test_a_key_of_what_was_not_made_may_be_used_again(client: TestClient) -> None:
    headers = {"Idempotency-Key": "k"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        problem(client.post("/api/v1/sweeps", json={"spec": FAKE}, headers=headers), 507)
    assert client.post("/api/v1/sweeps", json={"spec": FAKE}, headers=headers).status_code == 201


def test_a_database_without_space_says_so(client: TestClient, service: Service, finished: str) -> None:
    with service.engine.begin() as connection:
        pages = connection.exec_driver_sql("PRAGMA page_count").scalar()
    with limited(service, f"PRAGMA max_page_count = {pages}"):
        for _ in range(200):
            # The first ones go into what is left of pages.
            answer = client.post("/api/v1/sweeps/done/extend", json={"num_samples": 1})
            if answer.status_code != 202:
                break
        assert "disk" in problem(answer, 507)["detail"]
        assert client.get("/api/v1/sweeps/done").status_code == 200
    assert client.patch("/api/v1/sweeps/done", json={"note": "z"}).json()["note"] == "z"


def test_who_has_a_token_looks_and_deletes_where_its_use_can_not_be_noted(service: Service, finished: str) -> None:
    at = place(service, require_token=True)
    headers = bearer(at.token("admin"))
    with no_space_for_tokens(service.engine) as refused:
        answer = at.client().get("/api/v1/sweeps", headers=headers)
        assert answer.status_code == 200, answer.text
        # Else it would be believed, and not looked up.
        at.clock.s += FRESH_S
        assert at.client().delete("/api/v1/sweeps/done?force=true", headers=headers).status_code == 204
    assert len(refused) == 2
    assert not (Path(service.config.storage) / "done").exists()


@contextlib.contextmanager
def limited(service: Service, pragma: str) -> Iterator[None]:
    """Set something of all connections to the database for the block."""
    from sqlalchemy import event

    def set_it(connection: Any, *_: Any) -> None:
        connection.execute(pragma)

    event.listen(service.engine, "checkout", set_it)
    try:
        yield
    finally:
        event.remove(service.engine, "checkout", set_it)
        service.engine.dispose()


# -- a database that can't be used


def test_a_database_that_another_program_locks(client: TestClient, service: Service, finished: str) -> None:
    other = sqlite3.connect(str(service.engine.url.database), isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    try:
        for answer in (submit(client), client.get("/api/v1/sweeps/done"), client.delete("/api/v1/sweeps/done")):
            assert "database" in problem(answer, 503)["detail"]
            assert int(answer.headers["retry-after"]) > 0
        assert client.get("/healthz").status_code == 200
        assert "The database can't be used." in client.get("/readyz").json()["problems"]
    finally:
        other.rollback()
        other.close()
    assert files_of(service) >= {"done"}
    assert client.get("/api/v1/sweeps/done").status_code == 200
    assert submit(client).status_code == 201


@pytest.mark.parametrize("how", ["deleted", "replaced", "moved"])
def test_a_database_whose_file_is_gone(
    client: TestClient, service: Service, finished: str, folder_of_database: Path, how: str
) -> None:
    file, elsewhere = folder_of_database / "service.db", folder_of_database / "elsewhere.db"
    file.rename(elsewhere)
    if how == "deleted":
        elsewhere.unlink()
    elif how == "replaced":
        open_database(sqlite_url(file)).dispose()
    # What is written to a file without a name is lost with the process: nobody is told that it was done.
    for answer in (submit(client), client.patch("/api/v1/sweeps/done", json={"note": "x"})):
        assert "database" in problem(answer, 503)["detail"]
    assert "The database can't be used." in client.get("/readyz").json()["problems"]
    assert client.get("/healthz").status_code == 200
    assert not (Path(service.config.storage) / "mine").exists()
    if how == "moved":
        elsewhere.rename(file)
        assert submit(client).status_code == 201
    elif how == "deleted":
        # It makes no new one without tables, which the next start would take for the old one.
        assert not file.exists()


def test_a_service_does_not_start_on_a_newer_database(run: RunCommand, tmp_path: Path) -> None:
    url = sqlite_url(tmp_path / "newer.db")
    engine = open_database(url)
    with engine.begin() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
    engine.dispose()
    result = run("serve", "--port", 0, "--storage", tmp_path / "sweeps", "--database", url)
    assert result.exit_code == 5, result.output
    assert "is of a newer version (9999)" in result.output
    assert "Run the version of tune-jobs that wrote it" in result.output


class TestPostgreSQL:
    """A server of its own, which is stopped and started again."""

    @pytest.fixture
    def server(self) -> Iterator[PostgreSQL]:
        made = started_or_skip()
        yield made
        made.stop()

    @pytest.fixture
    def database_url(self, server: PostgreSQL) -> str:
        return server.new_database()

    def test_a_server_that_is_stopped_and_comes_back(
        self, client: TestClient, service: Service, finished: str, server: PostgreSQL
    ) -> None:
        assert submit(client).status_code == 201
        server.kill()
        for answer in (submit(client, name="other"), client.get("/api/v1/sweeps/mine")):
            assert "database" in problem(answer, 503)["detail"]
        assert client.get("/healthz").status_code == 200
        assert not (Path(service.config.storage) / "other").exists()
        server.start()
        assert client.get("/api/v1/sweeps/mine").status_code == 200
        assert submit(client, name="other").status_code == 201


# -- a cluster that is gone


def test_a_cluster_that_does_not_answer_is_named_in_the_job(tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    store.write_record(store.read_record().model_copy(update={"state": "created"}))
    request = {
        "sweep": str(store.folder), "verb": "drive", "arguments": {}, "address": "127.0.0.1:1", "attempt": 1,
        "wait_for_nodes": 0.0,
    }  # fmt: skip
    ended = _ended(request)
    assert ended.outcome == "failed"
    assert "127.0.0.1:1" in (ended.message or "")

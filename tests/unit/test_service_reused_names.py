"""A sweep under the name of one whose folder somebody removed: nothing of that one is said of it."""

import shutil
import time
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from service_access import OPEN, bearer, place
from services import FAKE, client, postgresql, service  # noqa: F401 (fixtures)
from sweep_folders import make_sweep_folder
from test_service_submitting import away

from policies.errors import CannotRunError, CheckpointError, TuneJobsError
from tune_jobs.service.database.opening import sqlite_url
from tune_jobs.service.queue import Queue
from tune_jobs.service.service import Service
from tune_jobs.service.views import ListView, SweepView
from tune_jobs.store.sweep_store import SweepStore

# ruff: noqa: F811 - fixtures are named as arguments

MINE = "/api/v1/sweeps/mine"
KEY = {"Idempotency-Key": "k"}
NEW = {"spec": FAKE, "name": "mine", "note": "for the paper", "tags": ["paper"], "priority": 7}
NOTHING: tuple[Any, ...] = (None, "", [], None)


@pytest.fixture
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The URL of a new database; of SQLite, where a test asks for no other."""
    if getattr(request, "param", "sqlite") == "sqlite":
        return sqlite_url(tmp_path / "service.db")
    server: Any = request.getfixturevalue("postgresql")
    return str(server.new_database())


def as_(name: str, service: Service) -> TestClient:
    """A client with a submitter's token of this name."""
    at = place(service, port=8265, **OPEN)
    return at.client(**bearer(at.token("submitter", name)))


def folder_of(service: Service) -> Path:
    return Path(service.config.storage) / "mine"


def submitted(service: Service, name: str = "ann", **options: Any) -> None:
    """Submit a sweep, whose job then fails."""
    answer = as_(name, service).post("/api/v1/sweeps", json=NEW, **options)
    assert answer.status_code == 201, answer.text
    service.queue.claim(1e9)
    service.queue.end(answer.json()["job"]["id"], "failed", "Its process died.")


def make_anew(service: Service, at: float | None = None) -> None:
    """Remove the sweep's folder, and write one of the name from a terminal."""
    shutil.rmtree(folder_of(service))
    store = make_sweep_folder(folder_of(service))
    store.write_record(store.read_record().model_copy(update={"created_at": time.time() if at is None else at}))


def said(summary: Any) -> tuple[Any, ...]:
    return summary["owner"], summary["note"], summary["tags"], summary["job"]


@pytest.mark.parametrize("database_url", ["sqlite", "postgresql"], indirect=True)
def test_a_new_sweep_has_nothing_of_the_one_before(client: TestClient, service: Service) -> None:
    submitted(service)
    before = client.get(MINE).json()
    assert said(before)[:3] == ("ann", "for the paper", ["paper"])
    assert before["job"]["outcome"] == "failed"
    whole = ListView(service.statuses, service.queue, service.labels)
    whole.changes()
    make_anew(service)
    assert said(client.get(MINE).json()) == NOTHING
    assert [said(sweep) for sweep in client.get("/api/v1/sweeps").json()["sweeps"]] == [NOTHING]
    assert client.get("/api/v1/sweeps", params={"owner": "ann"}).json()["sweeps"] == []
    assert client.get("/api/v1/sweeps", params={"tag": "paper"}).json()["sweeps"] == []
    ((kind, listed),) = whole.changes()
    assert (kind, [said(sweep) for sweep in listed["sweeps"]]) == ("sweeps", [NOTHING])
    view = SweepView("mine", service.storage, service.statuses, service.queue, service.labels)
    ((kind, followed),) = view.changes()
    assert (kind, said(followed)) == ("status", NOTHING)


def test_whose_the_one_before_was_may_not_change_the_new_one(client: TestClient, service: Service) -> None:
    ann = as_("ann", service)
    submitted(service)
    assert ann.patch(MINE, json={"note": "mine"}).status_code == 200
    make_anew(service)
    for asked in (
        ann.patch(MINE, json={"note": "mine"}),
        ann.post(f"{MINE}/stop"),
        ann.post(f"{MINE}/extend", json={"num_samples": 1}),
        ann.delete(MINE, params={"force": True}),
    ):
        assert asked.status_code == 403, asked.text
        assert "Sweep mine belongs to nobody" in asked.json()["detail"]
    assert service.storage.sweep("mine").exists()
    # What an admin says of it is said of the new one alone.
    assert said(client.patch(MINE, json={"note": "bob's"}).json()) == (None, "bob's", [], None)
    assert client.delete(MINE).status_code == 204


def test_a_folder_that_was_moved_away_is_whose_it_was_once_it_is_back(
    client: TestClient, service: Service, tmp_path: Path
) -> None:
    submitted(service)
    before = client.get(MINE).json()
    shutil.move(folder_of(service), tmp_path / "aside")
    assert client.get(MINE).status_code == 404
    shutil.move(tmp_path / "aside", folder_of(service))
    assert said(client.get(MINE).json()) == said(before)
    assert as_("ann", service).patch(MINE, json={"note": "again"}).json()["owner"] == "ann"
    # Of an earlier one that comes back nothing was said, either.
    make_anew(service, at=1.0)
    assert said(client.get(MINE).json())[:3] == NOTHING[:3]
    assert as_("ann", service).delete(MINE, params={"force": True}).status_code == 403


def test_a_damaged_sweep_is_deleted_by_whose_it_was(service: Service) -> None:
    submitted(service)
    (folder_of(service) / "sweep.json").write_text("{")
    assert as_("bob", service).delete(MINE, params={"force": True}).status_code == 403
    assert as_("ann", service).delete(MINE, params={"force": True}).status_code == 204


def unreadable_once(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the next look at a sweep, and no further one, find it damaged, as where no file can be opened just then."""
    see, looks = service.statuses.see, iter([CheckpointError("Too many open files.")])

    def once(name: str) -> Any:
        for error in looks:
            raise error
        return see(name)

    monkeypatch.setattr(service.statuses, "see", once)


def test_a_moment_in_which_it_cannot_be_read_makes_a_new_sweep_not_the_former_ones(
    client: TestClient, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    ann = as_("ann", service)
    submitted(service)
    make_anew(service)
    changes: tuple[tuple[str, str, Any, int], ...] = (
        ("PATCH", MINE, {"note": "mine"}, 500),
        ("POST", f"{MINE}/extend", {"num_samples": 1}, 500),
        # That one need not be readable.
        ("DELETE", f"{MINE}?force=true", None, 403),
    )
    for method, path, content, status in changes:
        with monkeypatch.context() as patch:
            unreadable_once(service, patch)
            answer = ann.request(method, path, json=content)
        assert answer.status_code == status, answer.text
    assert folder_of(service).exists()
    assert said(client.get(MINE).json()) == NOTHING


def test_who_may_not_change_a_damaged_sweep_is_told_so(service: Service) -> None:
    submitted(service)
    (folder_of(service) / "sweep.json").write_text("{")
    assert as_("bob", service).patch(MINE, json={"note": "mine"}).status_code == 403
    assert as_("ann", service).patch(MINE, json={"note": "mine"}).status_code == 500
    shutil.rmtree(folder_of(service))
    assert as_("bob", service).delete(MINE).status_code == 403
    assert as_("ann", service).delete(MINE).status_code == 404


@pytest.mark.parametrize("database_url", ["sqlite", "postgresql"], indirect=True)
@pytest.mark.parametrize("is_damaged", [False, True])
@pytest.mark.parametrize("is_labelled", [False, True])
def test_whoever_takes_the_name_of_a_sweep_while_it_is_deleted_has_the_new_one(
    client: TestClient, service: Service, monkeypatch: pytest.MonkeyPatch, *, is_damaged: bool, is_labelled: bool
) -> None:
    submitted(service)
    if not is_labelled:
        service.labels.forget("mine")
    if is_damaged:
        (folder_of(service) / "sweep.json").write_text("{")
    remove_sweep, bob = service.queue.remove_sweep, as_("bob", service)

    def removing(name: str) -> None:
        remove_sweep(name)
        assert bob.post("/api/v1/sweeps", json=NEW).status_code == 201

    monkeypatch.setattr(service.queue, "remove_sweep", removing)
    assert client.delete(MINE, params={"force": True}).status_code == 204
    assert said(client.get(MINE).json())[:3] == ("bob", "for the paper", ["paper"])


@pytest.mark.parametrize("created_at", [None, 0.0])
def test_of_a_sweep_that_is_deleted_nothing_stays(
    client: TestClient, service: Service, created_at: float | None
) -> None:
    for is_damaged in (False, True):
        make_sweep_folder(folder_of(service))
        service.labels.change("mine", owner="ann", created_at=created_at)
        if is_damaged:
            (folder_of(service) / "sweep.json").write_text("{")
        assert client.delete(MINE, params={"force": True}).status_code == 204
        assert service.labels.all() == {}


def test_of_a_sweep_of_a_name_that_is_deleted_no_former_one_is_left(client: TestClient, service: Service) -> None:
    submitted(service)
    make_anew(service)
    assert client.delete(MINE, params={"force": True}).status_code == 204
    assert service.labels.all() == {}


def unreadable(patch: pytest.MonkeyPatch, error: TuneJobsError) -> None:
    def read(_: SweepStore) -> None:
        raise error

    patch.setattr(SweepStore, "read_record", read)


@pytest.mark.parametrize("error", [CheckpointError("Too many open files."), CannotRunError("The store is away.")])
def test_a_sweep_that_cannot_be_read_when_it_was_written_is_whose_it_is(
    client: TestClient, service: Service, error: TuneJobsError
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        unreadable(patch, error)
        assert as_("ann", service).post("/api/v1/sweeps", json=NEW, headers=KEY).status_code == 201
    assert said(client.get(MINE).json())[:3] == ("ann", "for the paper", ["paper"])
    assert service.labels.of("mine").created_at == service.storage.sweep("mine").read_record().created_at


@pytest.mark.parametrize(
    ("error", "status"), [(CheckpointError("Too many open files."), 500), (CannotRunError("The store is away."), 503)]
)
def test_a_request_that_is_repeated_is_no_success_while_nothing_says_whose_the_sweep_is(
    client: TestClient, service: Service, error: TuneJobsError, status: int
) -> None:
    ann = as_("ann", service)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service.labels, "change", away)
        assert ann.post("/api/v1/sweeps", json=NEW, headers=KEY).status_code == 503
    with pytest.MonkeyPatch.context() as patch:
        unreadable(patch, error)
        assert ann.post("/api/v1/sweeps", json=NEW, headers=KEY).status_code == status
    assert client.get(MINE).json()["owner"] is None
    assert ann.post("/api/v1/sweeps", json=NEW, headers=KEY).status_code == 200
    assert client.get(MINE).json()["owner"] == "ann"


def test_a_label_that_does_not_say_of_which_sweep_counts(client: TestClient, service: Service) -> None:
    """So do those of earlier versions."""
    make_sweep_folder(folder_of(service))
    service.labels.change("mine", owner="ann", note="old")
    assert said(client.get(MINE).json()) == ("ann", "old", [], None)
    assert said(as_("ann", service).patch(MINE, json={"tags": ["x"]}).json()) == ("ann", "old", ["x"], None)
    make_anew(service)
    assert said(client.get(MINE).json()) == NOTHING


def test_a_request_that_is_repeated_makes_no_other_sweep_of_the_name_ones_own(
    client: TestClient, service: Service
) -> None:
    submitted(service, headers=KEY)
    for created_at, is_labelled in ((None, True), (None, False), (1.0, False)):
        make_anew(service, created_at)
        if not is_labelled:
            service.labels.forget("mine")
        assert as_("ann", service).post("/api/v1/sweeps", json=NEW, headers=KEY).status_code == 200
        assert client.get(MINE).json()["owner"] is None


def test_whose_a_sweep_is_could_not_be_written_though_one_of_the_name_was_anothers(
    client: TestClient, service: Service
) -> None:
    submitted(service, "bob")
    shutil.rmtree(folder_of(service))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service.labels, "change", away)
        assert as_("ann", service).post("/api/v1/sweeps", json=NEW, headers=KEY).status_code == 503
    assert client.get(MINE).json()["owner"] is None
    assert as_("ann", service).post("/api/v1/sweeps", json=NEW, headers=KEY).status_code == 200
    assert client.get(MINE).json()["owner"] == "ann"


def test_a_request_that_is_repeated_while_its_sweep_is_written_says_not_whose_another_one_is(
    client: TestClient, service: Service
) -> None:
    """The name may be taken yet, and the sweep gets another one then."""
    new = {key: value for key, value in NEW.items() if key != "name"} | {"default_name": "mine"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service.submitter, "_written", lambda job, *_: (job, 1.0))
        patch.setattr(service.queue, "created", lambda job_id, **_: service.queue.job(job_id))
        assert as_("ann", service).post("/api/v1/sweeps", json=new, headers=KEY).status_code == 201
    make_sweep_folder(folder_of(service))
    make_anew(service)
    assert as_("ann", service).post("/api/v1/sweeps", json=new, headers=KEY).json()["job"]["state"] == "creating"
    assert client.get(MINE).json()["owner"] is None


def test_what_is_added_to_a_new_sweep_has_the_priority_of_no_earlier_one(client: TestClient, service: Service) -> None:
    submitted(service)
    make_anew(service)
    answer = client.post(f"{MINE}/extend", json={"num_samples": 1})
    assert (answer.status_code, answer.json()["priority"]) == (202, 0)


def test_a_job_is_of_an_earlier_sweep_if_it_ended_before(service: Service) -> None:
    now = 100.0
    queue = Queue(service.engine, lambda: now)
    job, _ = queue.begin("mine", "drive", {}, owner="ann")
    assert not job.is_of_former(200.0)
    queue.claim(1.0)
    ended = queue.end(job.id, "completed")
    assert [ended.is_of_former(at) for at in (99.0, 100.0, 100.5)] == [False, False, True]

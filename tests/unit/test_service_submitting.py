"""Submissions that are repeated or come at once: one sweep each, whose it is, and no more than somebody may have."""

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from services import FAKE, client, service  # noqa: F401 (fixtures)
from sqlalchemy.exc import OperationalError

from policies.errors import SpecError
from tune_jobs.service.database.opening import sqlite_url
from tune_jobs.service.http.models import NewSweep
from tune_jobs.service.jobs import Job
from tune_jobs.service.service import Service

# ruff: noqa: F811 - fixtures are named as arguments

KEY = {"Idempotency-Key": "k"}


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """One kind of database is enough here."""
    return sqlite_url(tmp_path / "service.db")


def away(*_: Any, **__: Any) -> None:
    """What a database does that can't be reached."""
    raise OperationalError("UPDATE", {}, Exception("server closed the connection"))


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


def begun_at_once(service: Service, monkeypatch: pytest.MonkeyPatch, *keys: str) -> list[tuple[Job, bool]]:
    """Submit a named sweep, and again while it is planned: the second one is planned only after the first returned."""
    submission = NewSweep(spec=FAKE, name="mine").submission()
    planned = service.submitter._planned(submission)
    first_plans, second_plans, first_returned = threading.Event(), threading.Event(), threading.Event()

    def plan(_: Any) -> Any:
        if first_plans.is_set():
            second_plans.set()
            assert first_returned.wait(20)
        else:
            first_plans.set()
            assert second_plans.wait(20)
        return planned

    monkeypatch.setattr(service.submitter, "_planned", plan)
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(service.submitter.submit, submission, owner="ann", key=keys[0])
        assert first_plans.wait(20)
        second = pool.submit(service.submitter.submit, submission, owner="ann", key=keys[1])
        try:
            found = [first.result(30)]
        finally:
            first_returned.set()
        return [*found, second.result(30)]


def test_a_named_sweep_that_is_asked_for_again_while_it_is_planned_is_the_same(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    (first, first_is_new), (second, second_is_new) = begun_at_once(service, monkeypatch, "k", "k")
    assert (first.id, first_is_new, second_is_new) == (second.id, True, False)
    assert [job.sweep for job in service.queue.jobs()] == [sweep.name for sweep in service.storage.sweeps()] == ["mine"]


def test_another_request_for_a_name_that_is_taken_meanwhile_is_refused(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SpecError, match="is already in"):
        begun_at_once(service, monkeypatch, "k", "another")
    assert len(service.queue.jobs()) == len(service.storage.sweeps()) == 1


def test_a_request_takes_the_room_of_no_other_where_it_repeats_one_that_began_meanwhile(service: Service) -> None:
    submission = NewSweep(spec=FAKE).submission()
    first: list[Job] = []

    def full() -> None:
        first.append(service.submitter.submit(submission, owner="ann", key="k")[0])
        raise SpecError("There is no room.")

    again, is_new = service.submitter.submit(submission, owner="ann", key="k", check_room=full)
    assert (again.id, is_new) == (first[0].id, False)


def test_a_sweep_whose_owner_could_not_be_written_has_one_once_it_is_asked_for_again(
    client: TestClient, service: Service
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service.labels, "change", away)
        assert submit(client, headers=KEY) == 503
    assert submit(client, headers=KEY) == 200
    (job,) = service.queue.jobs()
    label = service.labels.of(job.sweep)
    assert (label.owner, label.note, label.tags) == (job.owner, "mine", ("a",))


@pytest.mark.parametrize("lost_after", [False, True])
def test_a_sweep_that_the_queue_was_not_told_of_waits_once_it_is_asked_for_again(
    client: TestClient, service: Service, monkeypatch: pytest.MonkeyPatch, *, lost_after: bool
) -> None:
    created = service.queue.created

    def lost(job_id: int, *, num_cpus: float) -> None:
        if lost_after:
            created(job_id, num_cpus=num_cpus)
        away()

    with monkeypatch.context() as patch:
        patch.setattr(service.queue, "created", lost)
        assert submit(client, headers=KEY) == 503
        # It is still away.
        assert submit(client, headers=KEY) == 503
    assert submit(client, headers=KEY) == 200
    (job,) = service.queue.jobs()
    assert (job.state, job.num_cpus > 0) == ("waiting", True)
    assert [sweep.name for sweep in service.storage.sweeps()] == [job.sweep]


def test_a_sweep_that_the_queue_was_not_told_of_waits_at_the_next_look(client: TestClient, service: Service) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service.queue, "created", away)
        assert submit(client) == 503
    assert [job.state for job in service.queue.jobs()] == ["creating"]
    # So that it starts no driver here.
    service.supervisor._draining.set()
    for _ in range(2):
        service.supervisor._look()
    assert [job.state for job in service.queue.jobs()] == ["waiting"]


def test_a_sweep_that_could_not_be_written_while_the_queue_was_away_is_made_anew(
    client: TestClient, service: Service
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tune_jobs.service.submitting.write_new", away)
        patch.setattr(service.queue, "forget", away)
        assert submit(client, headers=KEY) == 503
    assert service.storage.sweeps() == []
    assert submit(client, headers=KEY) == 201
    (job,) = service.queue.jobs()
    assert job.state == "waiting"


@pytest.mark.parametrize(
    ("fields", "status", "words"),
    [
        ({"points": [{"lr": "fast"}]}, 422, "points[0]: lr: 'fast' is not a number"),
        ({"points": [{"lr": 1e-3}]}, 201, ""),
        ({"search": "gp", "num_samples": 20, "prior": "../elsewhere"}, 422, "no name of a sweep"),
        ({"search": "gp", "num_samples": 20, "prior": "missing"}, 422, "prior: No sweep 'missing'"),
        ({"prior": "missing"}, 422, "prior: is for a search that learns"),
    ],
)
def test_points_and_earlier_sweeps_are_checked_and_places_are_not_read(
    fields: dict[str, Any], status: int, words: str, client: TestClient
) -> None:
    spec = {**FAKE, "space": {"lr": {"loguniform": [1e-4, 1e-2]}}, **fields}
    answer = client.post("/api/v1/sweeps", json={"spec": spec})
    assert answer.status_code == status, answer.text
    assert words in answer.json().get("detail", "")


def test_a_name_that_its_number_would_make_too_long_is_refused(client: TestClient, service: Service) -> None:
    """No version would read the record of such a sweep."""
    for length, names in ((98, ["a" * 98, "a" * 98 + "-2"]), (99, ["a" * 99])):
        for name in names:
            answer = client.post("/api/v1/sweeps", json={"spec": FAKE, "default_name": "a" * length})
            assert (answer.status_code, answer.json().get("sweep")) == (201, name)
    answer = client.post("/api/v1/sweeps", json={"spec": FAKE, "default_name": "a" * 99})
    assert answer.status_code == 422, answer.text
    assert f"The sweep would be called '{'a' * 99}-2', as '{'a' * 99}' is taken" in answer.json()["detail"]
    assert "Give another name" in answer.json()["hint"]
    assert len(service.queue.jobs()) == len(service.storage.sweeps()) == 3


def test_no_sweep_is_called_as_a_baseline_is(client: TestClient) -> None:
    answer = client.post("/api/v1/sweeps", json={"spec": FAKE, "default_name": "random"})
    assert (answer.status_code, answer.json().get("sweep")) == (201, "random-sweep")
    for given in ({"spec": FAKE, "name": "constant"}, {"spec": {**FAKE, "name": "constant"}}):
        answer = client.post("/api/v1/sweeps", json=given)
        assert answer.status_code == 422, answer.text
        assert "The sweep name 'constant' is not allowed" in answer.json()["detail"]

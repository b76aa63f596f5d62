"""How many CPUs a job of a service takes: as many as what is left of its sweep can use, and its driver uses no more."""

from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from services import FAKE, client, service  # noqa: F401 (fixtures)
from sweep_folders import make_sweep_folder

from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.service import driver
from tune_jobs.service.database.opening import sqlite_url
from tune_jobs.service.jobs import Job
from tune_jobs.service.service import Service
from tune_jobs.spec.file import load_spec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import drive, verbs

# ruff: noqa: F811 - fixtures are named as arguments

MINE = "/api/v1/sweeps/mine"
NUM_CPUS = 16


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """One kind of database is enough here."""
    return sqlite_url(tmp_path / "service.db")


@pytest.fixture
def store(service: Service) -> SweepStore:
    """A completed sweep of 2 points with 2 seeds each, which a job for one CPU ran, on a machine of 16 CPUs."""
    object.__setattr__(service.supervisor.where, "num_cpus", float(NUM_CPUS))
    job, _ = service.queue.begin("mine", "drive", {}, owner="local", num_cpus=1.0)
    service.queue.end(job.id, "completed")
    return make_sweep_folder(Path(service.config.storage) / "mine")


def ask(client: TestClient, verb: str, body: Any = None) -> Job:
    answer = client.post(f"{MINE}/{verb}", json=body)
    assert answer.status_code == 202, answer.text
    return Job.model_validate(answer.json())


def change(store: SweepStore, trial_id: str, status: str) -> None:
    trial = store.trial(trial_id)
    trial.write_record(trial.read_record().model_copy(update={"status": status}))


# -- jobs


@pytest.mark.parametrize(
    ("verb", "body", "num_cpus"),
    [
        ("resume", None, 1), ("extend", {"num_samples": 3}, 6), ("extend", {"num_samples": 100}, NUM_CPUS),
        ("trials", {"point": {"lr": 5e-3}}, 2), ("replicate", {"top": 2, "seeds": 5}, 2),
    ],
)  # fmt: skip
def test_a_job_takes_as_many_as_what_it_adds_can_use(  # noqa: PLR0917 (fixtures)
    client: TestClient, service: Service, store: SweepStore, verb: str, body: Any, num_cpus: int
) -> None:
    assert ask(client, verb, body).num_cpus == num_cpus


def test_what_is_left_and_what_waits_counts_too(client: TestClient, store: SweepStore) -> None:
    for trial_id, status in (("t0000", "pending"), ("t0001", "failed"), ("t0002", "running")):
        change(store, trial_id, status)
    assert ask(client, "resume").num_cpus == 2
    assert ask(client, "retry").num_cpus == 3
    assert ask(client, "extend", {"num_samples": 1}).num_cpus == 4
    # By then the sweep may have stopped, with all of that still to be run.
    assert ask(client, "trials", {"point": {"lr": 5e-3}}).num_cpus == 6


def test_trials_of_several_cpus_count_with_all_of_them(client: TestClient, store: SweepStore) -> None:
    record = store.read_record()
    resources = {"num_cpus": 3}
    store.write_record(record.model_copy(update={"spec": record.spec | {"resources": resources}}))
    assert ask(client, "extend", {"num_samples": 1}).num_cpus == 6


def test_a_job_takes_no_fewer_than_the_one_before(client: TestClient, service: Service, store: SweepStore) -> None:
    job, _ = service.queue.begin("mine", "drive", {}, owner="local", num_cpus=9.0)
    service.queue.end(job.id, "completed")
    assert ask(client, "resume").num_cpus == 9
    assert ask(client, "trials", {"point": {"lr": 5e-3}}).num_cpus == 9


def test_what_was_never_planned_here_takes_all(client: TestClient, service: Service) -> None:
    object.__setattr__(service.supervisor.where, "num_cpus", float(NUM_CPUS))
    make_sweep_folder(Path(service.config.storage) / "mine")
    assert ask(client, "resume").num_cpus == NUM_CPUS


def test_extended_sweeps_run_one_after_the_other_where_they_do_not_fit(
    client: TestClient, service: Service, store: SweepStore
) -> None:
    make_sweep_folder(Path(service.config.storage) / "other")
    job, _ = service.queue.begin("other", "drive", {}, owner="local", num_cpus=1.0)
    service.queue.end(job.id, "completed")
    for name in ("mine", "other"):
        assert client.post(f"/api/v1/sweeps/{name}/extend", json={"num_samples": 5}).status_code == 202
    assert service.queue.claim(NUM_CPUS) is not None
    # Of 10 trials each, 16 at once would be more than the machine's CPUs.
    assert service.queue.claim(NUM_CPUS) is None
    assert service.queue.load().num_cpus == 10


# -- drivers


@pytest.fixture
def machines(monkeypatch: pytest.MonkeyPatch) -> list[Machine]:
    """What each sweep that is driven finds, on a machine of 16 CPUs."""
    found: list[Machine] = []

    def note(*_: Any, **__: Any) -> Any:
        found.append(drive.machine_here())

    monkeypatch.setattr(drive, "local_machine", lambda: Machine(NUM_CPUS, memory_bytes=1e9))
    for name in ("resume", "extend", "inject", "replicate"):
        monkeypatch.setattr(verbs, name, note)
    return found


@pytest.mark.parametrize(
    ("verb", "arguments"),
    [
        ("drive", {}), ("retry", {}), ("extend", {"to_num_samples": 9}), ("inject", {"point": {"lr": 5e-3}}),
        ("replicate", {"top": 2, "seeds": 2}),
    ],
)  # fmt: skip
def test_a_driver_plans_its_sweep_for_the_cpus_of_its_job(
    tmp_path: Path, machines: list[Machine], verb: str, arguments: dict[str, Any]
) -> None:
    place = make_sweep_folder(tmp_path / "mine").place
    request = {"sweep": place, "verb": verb, "arguments": arguments, "address": None, "wait_for_nodes": 0.0, "job": "a"}
    for num_cpus in (3.0, 64.0):
        driver._done(request | {"num_cpus": num_cpus})
    assert machines == [Machine(3.0, memory_bytes=1e9), Machine(NUM_CPUS, memory_bytes=1e9)]
    assert drive.machine_here().num_cpus == NUM_CPUS


def test_one_trial_runs_whatever_an_earlier_version_wrote(tmp_path: Path, machines: list[Machine]) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    record = store.read_record()
    store.write_record(record.model_copy(update={"spec": record.spec | {"resources": {"num_cpus": 4}}}))
    how: dict[str, Any] = {"verb": "drive", "arguments": {}, "address": None, "wait_for_nodes": 0.0, "num_cpus": 1.0}
    driver._done(how | {"sweep": store.place})
    assert machines[0].num_cpus == 4


def test_the_ray_that_is_kept_warm_counts_with_as_many(monkeypatch: pytest.MonkeyPatch) -> None:
    warm = Machine(NUM_CPUS, nodes=((NUM_CPUS, 0.0),))
    monkeypatch.setattr(drive, "_is_connected_by_user", lambda: True)
    monkeypatch.setattr("tune_jobs.ray_tune.connected_ray.connected_machine", lambda: warm)
    with drive.within_cpus(3.0):
        assert drive.machine_here().fitting(1.0, 0.0) == 3
    assert drive.machine_here().fitting(1.0, 0.0) == NUM_CPUS


@pytest.mark.parametrize(("most", "at_once"), [(64.0, 14), (80.0, 14), (8.0, 8)])
def test_the_ray_that_is_kept_warm_runs_no_more_than_its_memory_allows(
    monkeypatch: pytest.MonkeyPatch, most: float, at_once: int
) -> None:
    """Also where a job has all CPUs: it is this machine, and not a cluster that nodes may join."""
    warm = Machine(64.0, nodes=((64.0, 0.0),), memory_bytes=8e9)
    monkeypatch.setattr(drive, "_is_connected_by_user", lambda: True)
    monkeypatch.setattr("tune_jobs.ray_tune.connected_ray.connected_machine", lambda: warm)
    fields: dict[str, Any] = {"env": "CartPole-v1", "algorithm": "ppo", "engine": "rllib", "num_samples": 64}
    spec = load_spec(fields | {"space": {"lr": {"uniform": [1e-4, 1e-3]}}, "confirm": "none"})
    with drive.within_cpus(most):
        assert make_plan(spec, drive.machine_here()).max_concurrent == at_once
    # A Ray that a user has joined may be a cluster.
    assert drive.machine_here() == warm


def test_the_driver_is_told_the_cpus_of_its_job(service: Service, store: SweepStore) -> None:
    given: list[dict[str, Any]] = []

    class Asked:
        pid = 1

        def give(self, request: dict[str, Any], *_: Any) -> None:
            given.append(request)

    service.supervisor._make_driver = lambda _: Asked()  # type: ignore[assignment, return-value]
    job, _ = service.queue.begin("mine", "drive", {}, owner="local", num_cpus=5.0)
    service.supervisor._start(job)
    assert [request["num_cpus"] for request in given] == [5.0]


# -- turns


def test_a_job_has_the_priority_of_the_last_one(client: TestClient, service: Service, store: SweepStore) -> None:
    assert ask(client, "extend", {"num_samples": 1}).priority == 0
    assert client.patch(MINE, json={"priority": 7}).status_code == 200
    assert ask(client, "resume").priority == 7
    client.post(f"{MINE}/stop")
    assert ask(client, "replicate", {"top": 2}).priority == 7


def test_a_priority_that_nothing_waits_with_is_refused(client: TestClient, service: Service, store: SweepStore) -> None:
    before = client.get(MINE).json()
    for state, told in (("ended", "nothing of it is to be run"), ("running", "its job runs already")):
        answer = client.patch(MINE, json={"priority": 7, "note": "new"})
        assert answer.status_code == 409
        assert answer.json()["detail"].startswith("Sweep mine has no job that waits")
        assert told in answer.json()["detail"]
        assert "Leave the priority out" in answer.json()["hint"]
        # Nothing was changed.
        assert client.get(MINE).json() == before
        if state == "ended":
            ask(client, "resume")
            assert service.queue.claim(NUM_CPUS) is not None
            before = client.get(MINE).json()
    assert client.patch(MINE, json={"note": "new"}).json()["note"] == "new"


def test_a_sweep_that_waits_takes_a_priority(client: TestClient, service: Service) -> None:
    assert client.post("/api/v1/sweeps", json={"spec": FAKE, "name": "mine"}).status_code == 201
    assert client.patch(MINE, json={"priority": -3}).json()["job"]["priority"] == -3

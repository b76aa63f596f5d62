"""Jobs of a service on a cluster, whose CPUs nobody counts: each says a number, as JSON has no infinity."""

import json
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from services import client  # noqa: F401 (a fixture)
from sqlalchemy import select
from sweep_folders import make_sweep_folder

from tune_jobs.client import answers
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.database.tables import messages
from tune_jobs.service.queue import Queue
from tune_jobs.service.service import Service, opened

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    """A service on a cluster; its queue stands still, and it finds two sweeps of others, one of which has not begun."""
    for name, state in (("mine", "interrupted"), ("waits", "created")):
        store = make_sweep_folder(tmp_path / "sweeps" / name)
        store.write_record(store.read_record().model_copy(update={"state": state}))
    config = ServiceConfig(
        storage=tmp_path / "sweeps", spare_idle_s=0.0, address="auto", webhooks=("http://127.0.0.1:9/hook",)
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tune_jobs.service.supervisor.Supervisor._look", lambda _: None)
        with opened(config) as made:
            yield made


def test_what_was_not_planned_here_has_a_number_of_cpus(client: TestClient, service: Service) -> None:
    found = client.post("/api/v1/sweeps/mine/resume").json()
    assert answers.Job.model_validate(found).num_cpus == 1.0
    jobs = client.get("/api/v1/jobs").json()
    assert {job["sweep"]: job["num_cpus"] for job in jobs} == {"mine": 1.0, "waits": 1.0}
    for _ in jobs:
        # They share no CPUs that were counted.
        assert service.queue.claim(service.supervisor.where.num_cpus) is not None
    assert service.queue.load().num_cpus == 2.0


def test_webhooks_get_json_of_it(client: TestClient, service: Service) -> None:
    client.post("/api/v1/sweeps/mine/resume")
    job = service.queue.jobs(sweep="mine")[0]
    service.supervisor._on_end(job.model_copy(update={"state": "ended", "outcome": "completed"}))
    with service.engine.begin() as connection:
        body = connection.execute(select(messages.c.body)).scalar_one()
    assert json.loads(body)["data"]["job"]["num_cpus"] == 1.0


def test_jobs_of_earlier_versions_have_one_too(service: Service) -> None:
    queue = Queue(service.engine)
    job, _ = queue.begin("mine", "drive", {}, owner="ann", num_cpus=math.inf)
    assert queue.job(job.id).num_cpus == job.num_cpus == 1.0


def test_the_client_understands_an_earlier_service(client: TestClient) -> None:
    found = client.post("/api/v1/sweeps/mine/resume").json()
    assert answers.Job.model_validate(found | {"num_cpus": None}).num_cpus is None

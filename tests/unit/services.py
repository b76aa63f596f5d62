"""A service without Ray for tests: real database, folders, HTTP, supervisor; its sweeps only wait (`fake_driver`)."""

import functools
from collections.abc import Iterator
from pathlib import Path

import pytest
from databases import database_url, postgresql
from fastapi.testclient import TestClient

from tune_jobs.service import service as module
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.http.app import make_app
from tune_jobs.service.service import Service, opened
from tune_jobs.service.spare import Driver
from tune_jobs.service.supervisor import Supervisor

__all__ = ["client", "database_url", "postgresql", "service"]

FAKE = {"env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"loguniform": [1e-4, 1e-2]}}, "num_samples": 4}


@pytest.fixture
def service(tmp_path: Path, database_url: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Service]:
    """A service over an empty storage folder; its queue stands still until `supervisor` is woken."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    monkeypatch.setattr(
        module, "Supervisor", functools.partial(Supervisor, make_driver=functools.partial(Driver, module="fake_driver"))
    )
    config = ServiceConfig(storage=tmp_path / "sweeps", database=database_url, spare_idle_s=0.0)
    with opened(config) as made:
        # The tests that want sweeps to run start it themselves.
        made.supervisor.close()
        yield made


@pytest.fixture
def client(service: Service) -> Iterator[TestClient]:
    """A client of the service; errors of the server are answers, as over a network."""
    with TestClient(make_app(service), base_url="http://127.0.0.1:8265", raise_server_exceptions=False) as made:
        yield made

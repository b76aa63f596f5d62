"""What a sweep may have at most is counted before anything is planned."""

from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from service_access import problem
from services import FAKE, client, service  # noqa: F401 (fixtures)

from tune_jobs.plan.sweep_plan import SweepPlan, make_plan
from tune_jobs.service.database.opening import sqlite_url
from tune_jobs.service.service import Service
from tune_jobs.spec.sweep_spec import SweepSpec

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    return sqlite_url(tmp_path / "service.db")


@pytest.mark.parametrize("path", ["plans", "sweeps"])
def test_too_many_trials_are_not_even_planned(
    client: TestClient, service: Service, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    """To plan them takes seconds of the service for each ten thousand."""
    planned: list[int] = []

    def plan(spec: SweepSpec, *arguments: Any, **named: Any) -> SweepPlan:
        made = make_plan(spec, *arguments, **named)
        planned.append(len(made.trials))
        return made

    monkeypatch.setattr("tune_jobs.service.submitting.make_plan", plan)
    object.__setattr__(service.config.limits, "trials", 12)
    grid = FAKE | {"space": {"lr": {"grid": [1e-3, 1e-2]}}, "seeds_per_point": 3, "num_samples": 2}
    assert client.post(f"/api/v1/{path}", json={"spec": grid}).is_success
    assert planned == [12]
    chosen = FAKE | {"search": "tpe", "points": [{"lr": 1e-3}], "num_samples": 12}
    too_many = {"18": grid | {"num_samples": 3}, "6,000,000": grid | {"num_samples": 10**6}, "13": chosen}
    for number, spec in too_many.items():
        found = problem(client.post(f"/api/v1/{path}", json={"spec": spec}), 422)
        assert f"The sweep has {number} trials; here a sweep may have at most 12." in found["detail"]
    assert planned == [12]


@pytest.mark.parametrize("path", ["plans", "sweeps"])
def test_of_too_many_points_none_is_looked_at(
    client: TestClient, service: Service, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    def look(*_: Any, **__: Any) -> None:
        raise AssertionError("a point was looked at")

    monkeypatch.setattr("tune_jobs.search.given_points.checked_point", look)
    object.__setattr__(service.config.limits, "trials", 12)
    points = [{"lr": 1e-3 * number} for number in range(1, 6)]
    spec = FAKE | {"space": {"lr": {"uniform": [1e-4, 1e-2]}}, "seeds_per_point": 2, "num_samples": 2, "points": points}
    found = problem(client.post(f"/api/v1/{path}", json={"spec": spec}), 422)
    assert "The sweep has 14 trials; here a sweep may have at most 12." in found["detail"]

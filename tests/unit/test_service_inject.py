"""A point of one's own by HTTP: `POST .../trials` lets a job wait, or says what is wrong."""

import json
from pathlib import Path
from typing import Any

import pytest
from databases import database_url, postgresql  # noqa: F401 (fixtures)
from fastapi.testclient import TestClient
from services import client, service  # noqa: F401 (fixtures)
from sweep_folders import make_sweep_folder

from tune_jobs.service.service import Service

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture
def finished(service: Service) -> str:
    make_sweep_folder(Path(service.config.storage) / "done", space={"lr": {"uniform": [1e-4, 1e-2]}})
    return "/api/v1/sweeps/done/trials"


def test_a_request_lets_a_job_wait_with_the_point_in_the_sweeps_words(client: TestClient, finished: str) -> None:
    answer = client.post(finished, json={"point": {"lr": 1}})
    assert answer.status_code == 202
    assert (answer.json()["verb"], answer.json()["arguments"]) == ("inject", {"point": {"lr": 1.0}})
    again = client.post(finished, json={"point": {"lr": 1.0}})
    assert (again.status_code, "that job already" in again.json()["detail"]) == (409, True)
    # Another point waits behind it.
    assert client.post(finished, json={"point": {"lr": 0.5}}).json()["state"] == "waiting"


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"point": {"lrr": 1e-3}}, "Did you mean 'lr'?"),
        ({"point": {}}, "it has no lr"),
        ({"point": {"lr": "x"}}, "is not a number"),
        ({"point": {"lr": -1}}, "greater than 0"),
        ({"point": [1]}, "point"),
        ({}, "point"),
        ({"point": {"lr": 1e-3}, "more": 1}, "more"),
    ],
)
def test_what_is_wrong_is_said_and_no_job_is_made(
    client: TestClient, service: Service, finished: str, body: Any, words: str
) -> None:
    answer = client.post(finished, json=body)
    assert answer.status_code == 422
    assert words in json.dumps(answer.json())
    assert service.queue.jobs() == []


def test_known_points_limits_and_sweeps_that_are_not_there(client: TestClient, service: Service, finished: str) -> None:
    known = client.get(finished).json()["trials"][0]
    told = client.post(finished, json={"point": known["point"]}).json()
    assert "has this point already: trial t000" in told["detail"]
    assert client.post("/api/v1/sweeps/none/trials", json={"point": {"lr": 1e-3}}).status_code == 404
    # 4 trials are there; each point has two.
    object.__setattr__(service.config.limits, "trials", 6)
    assert client.post(finished, json={"point": {"lr": 1e-3}}).status_code == 202
    told = client.post(finished, json={"point": {"lr": 2e-3}}).json()
    assert "would have 8 trials; here a sweep may have at most 6" in told["detail"]

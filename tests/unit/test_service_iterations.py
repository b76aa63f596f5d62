"""What the page of a trial asks for every two seconds: the iterations after the last that it knows."""

from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from services import client, service  # noqa: F401 (fixtures)
from store_parts import make_iteration
from test_service_downloads import make_finished

from analysis.records import IterationRecord
from tune_jobs.service.database.opening import sqlite_url
from tune_jobs.service.http.sweep_routes import iteration_row
from tune_jobs.service.service import Service

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    return sqlite_url(tmp_path / "service.sqlite")


class Untouched(tuple[Any, ...]):
    """Values at which nobody may look."""

    __slots__ = ()

    def __iter__(self) -> Any:
        raise AssertionError


def test_what_the_page_knows_is_not_read_again(
    client: TestClient, service: Service, caplog: pytest.LogCaptureFixture
) -> None:
    trial = make_finished(Path(service.config.storage) / "done").trial("t0003")
    known, new = trial.results_path.read_text().splitlines()[:4], trial.read_iterations(4)
    # They can't be parsed, which nobody notices who doesn't.
    broken = [line.replace('"num_episodes":', "?") for line in known]
    trial.results_path.write_text("\n".join(broken) + "\n")
    trial.append_iterations(new)
    rows = client.get("/api/v1/sweeps/done/trials/t0003/iterations", params={"after": 4}).json()
    assert rows == [iteration_row(item) for item in new]
    assert [row["iteration"] for row in rows] == [5, 6]
    assert "damaged" not in caplog.text


def test_single_episodes_are_not_looked_at() -> None:
    item = make_iteration(3, training_return=2.5, learner={"entropy": 0.5})
    episodes = {"episode_returns": Untouched([1.0] * 100), "episode_lengths": Untouched([20] * 100)}
    row = iteration_row(item.model_copy(update=episodes))
    assert row == iteration_row(item)
    assert set(row) == set(IterationRecord.model_fields) - set(episodes)

"""Sweeps' folders that people have had their hands on: renamed, or with a record that can't be read."""

from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from services import client, service  # noqa: F401 (fixtures)
from sweep_folders import make_sweep_folder

from tune_jobs.service.database.opening import sqlite_url
from tune_jobs.service.service import Service

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """One kind of database is enough here."""
    return sqlite_url(tmp_path / "service.db")


def test_a_sweep_whose_folder_was_renamed_has_the_name_of_the_folder(client: TestClient, service: Service) -> None:
    made = make_sweep_folder(Path(service.config.storage) / "before")
    made.folder.rename(made.folder.with_name("after"))
    (item,) = client.get("/api/v1/sweeps").json()["sweeps"]
    assert item["name"] == "after"
    assert client.get(f"/api/v1/sweeps/{item['name']}").json() == item
    (status,) = client.get("/api/v1/statuses").json()["statuses"]
    assert status["sweep"]["name"] == client.get("/api/v1/sweeps/after/status").json()["sweep"]["name"] == "after"
    assert client.get("/api/v1/sweeps/before").status_code == 404
    assert client.delete("/api/v1/sweeps/after", params={"force": True}).status_code == 204


@pytest.mark.parametrize("damaged", ["{", "{}", "null", ""])
def test_a_sweep_whose_record_is_damaged_says_so_and_can_be_removed(
    client: TestClient, service: Service, damaged: str
) -> None:
    made = make_sweep_folder(Path(service.config.storage) / "mine")
    (made.folder / "sweep.json").write_text(damaged)
    told = client.get("/api/v1/sweeps/mine")
    assert (told.status_code, told.json()["error"]) == (500, "CheckpointError")
    assert "sweep.json" in told.json()["detail"]
    refused = client.delete("/api/v1/sweeps/mine")
    assert (refused.status_code, refused.json()["detail"]) == (500, told.json()["detail"])
    assert "force=true" in refused.json()["hint"]
    with made.lock():
        # Somebody drives it, who read the record before.
        assert client.delete("/api/v1/sweeps/mine", params={"force": True}).status_code == 409
    assert made.folder.exists()
    assert client.delete("/api/v1/sweeps/mine", params={"force": True}).status_code == 204
    assert not made.folder.exists()
    assert client.get("/api/v1/sweeps/mine").status_code == 404

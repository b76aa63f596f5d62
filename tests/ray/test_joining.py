"""What `tune_jobs.ray_tune.cluster` and `tune_jobs.ray_tune.address` take for granted about Ray, and work around."""

import os
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ray

FORK_FAILURE = "Initialization failure from server:\nRuntimeError: Starting Ray client server failed. See the log."


def test_the_last_cluster_is_recorded_where_ray_records_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import ray._common.utils

    from tune_jobs.ray_tune.address import recorded_cluster

    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    path = Path(ray._common.utils.get_ray_address_file(None))
    path.parent.mkdir(parents=True)
    path.write_text("192.0.2.7:6379")
    assert recorded_cluster() == "192.0.2.7:6379"


@pytest.mark.parametrize(("error", "attempts"), [(FORK_FAILURE, 3), ("ray client connection timeout", 1)])
def test_only_a_client_server_that_died_in_its_fork_is_asked_for_again(
    monkeypatch: pytest.MonkeyPatch, error: str, attempts: int
) -> None:
    from tune_jobs.ray_tune import cluster

    asked = []

    def init(address: str, **_: Any) -> None:
        asked.append(address)
        if len(asked) < 3:
            raise ConnectionAbortedError(error)

    monkeypatch.setattr("tune_jobs.ray_tune.cluster.ray.init", init)
    if attempts == 1:
        with pytest.raises(ConnectionAbortedError):
            cluster._init_patiently("ray://host:10001")
    else:
        cluster._init_patiently("ray://host:10001")
    assert asked == ["ray://host:10001"] * attempts


def test_a_client_server_that_dies_every_time_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    from policies.errors import CannotRunError
    from tune_jobs.ray_tune import cluster

    def init(address: str, **_: Any) -> None:
        raise ConnectionAbortedError(FORK_FAILURE)

    monkeypatch.setattr(cluster, "check_is_ray", lambda _: None)
    monkeypatch.setattr("tune_jobs.ray_tune.cluster.ray.init", init)
    with pytest.raises(CannotRunError, match="cannot be joined: Initialization failure from server"):
        cluster._join("ray://host:10001")


def test_a_refused_token_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from policies.errors import CannotRunError
    from tune_jobs.ray_tune import cluster

    def init(address: str, **_: Any) -> None:
        os.write(2, b"W gcs_client.cc:210: Failed to get cluster ID: InvalidAuthToken: token is missing or incorrect\n")
        raise ConnectionError("Failed to connect")

    monkeypatch.setattr(cluster, "check_is_ray", lambda _: None)
    monkeypatch.setattr("tune_jobs.ray_tune.cluster.ray.init", init)
    with pytest.raises(CannotRunError, match="does not accept this machine's token"):
        cluster._join("host:6379")


@pytest.mark.parametrize(("named", "is_refused"), [("", True), ("auto", True), ("192.0.2.9:6379", False)])
def test_auto_joins_no_other_ray_of_this_machine_than_the_recorded_one_unless_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, named: str, *, is_refused: bool
) -> None:
    from policies.errors import CannotRunError
    from tune_jobs.ray_tune import cluster

    class Context:
        gcs_address = "192.0.2.9:6379"

    left: list[str] = []
    monkeypatch.setenv("RAY_ADDRESS", named)
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    (tmp_path / "ray").mkdir()
    (tmp_path / "ray" / "ray_current_cluster").write_text("192.0.2.7:6379")
    monkeypatch.setattr(cluster, "check_is_ray", lambda _: None)
    monkeypatch.setattr("tune_jobs.ray_tune.cluster.ray.init", lambda address, **_: None)
    monkeypatch.setattr("tune_jobs.ray_tune.cluster.ray.get_runtime_context", Context)
    monkeypatch.setattr("tune_jobs.ray_tune.cluster.ray.shutdown", lambda: left.append("it"))
    if is_refused:
        with pytest.raises(CannotRunError, match=r"last joined 192\.0\.2\.7:6379"):
            cluster._join("auto")
    else:
        cluster._join("auto")
    assert left == ["it"] * is_refused

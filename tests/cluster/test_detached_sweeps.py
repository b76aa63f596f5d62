"""A sweep that a job of a cluster drives: begun, shown, stopped and ended from elsewhere, with the storage alone."""

import importlib.util
import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.cluster.ray_nodes import BIN, Cluster, free_port, processes_naming

pytestmark = [
    pytest.mark.cluster,
    pytest.mark.skipif(importlib.util.find_spec("aiohttp") is None, reason="needs the extra cluster: ray[default]"),
]

SWEEP = {
    "env": "CartPole-v1",
    "algorithm": "ppo",
    "space": {"lr": {"loguniform": [1e-3, 1e-2]}},
    "num_samples": 2,
    "hyperparams": {"num_envs": 2, "train_batch_size": 256},
    "stop": {"num_env_steps": 400_000},
    "evaluation": {"every_iterations": 50, "num_episodes": 2},
    "confirm": "none",
}


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    cluster = Cluster(tmp_path_factory.mktemp("cluster"))
    cluster.environment["PATH"] = f"{BIN}{os.pathsep}{os.environ['PATH']}"
    try:
        cluster.start_head(dashboard_port=free_port())
        yield cluster
    finally:
        cluster.stop()


def tune_jobs(cluster: Cluster, *words: str) -> subprocess.CompletedProcess[str]:
    return cluster.run([BIN / "tune-jobs", *words, "--storage", cluster.folder / "sweeps", "--json"])


def told(done: subprocess.CompletedProcess[str], code: int = 0) -> Any:
    assert done.returncode == code, done.stderr
    return json.loads(done.stdout)


def test_a_sweep_is_begun_stopped_killed_and_ended_from_elsewhere(cluster: Cluster) -> None:
    (cluster.folder / "mine.yaml").write_text(yaml.safe_dump(SWEEP))
    there = ("--address", cluster.jobs_address, "--no-finish")
    begun = told(tune_jobs(cluster, "launch", "mine.yaml", "--detach", *there))
    assert begun["state"] == "running"
    assert told(tune_jobs(cluster, "status", "mine"))["job"]["state"] == "running"
    again = tune_jobs(cluster, "resume", "mine", "--detach", *there)
    assert "is being run by another process" in told(again, 5)["error"]
    assert told(tune_jobs(cluster, "stop", "mine"))["was_running"]
    assert told(tune_jobs(cluster, "attach", "mine"), 130)["sweep"]["state"] == "interrupted"

    # Whoever asks resumes a sweep whose driver died.
    told(tune_jobs(cluster, "resume", "mine", "--detach", *there))
    for pid in processes_naming(f"resume\0{cluster.folder / 'sweeps' / 'mine'}"):
        os.kill(pid, signal.SIGKILL)
    assert told(tune_jobs(cluster, "attach", "mine"), 5)["error"]
    record = cluster.folder / "sweeps" / "mine" / "sweep.json"
    deadline = time.monotonic() + 60
    while told(tune_jobs(cluster, "status", "mine"))["alive"] and time.monotonic() < deadline:
        time.sleep(0.5)
    # Without --detach the table is shown to the end.
    ended = told(tune_jobs(cluster, "resume", "mine", *there))
    assert (ended["sweep"]["state"], ended["exit_code"]) == ("completed", 0)
    assert json.loads(record.read_text())["job"]["id"] not in (begun["job"], None)
    secret = Path(cluster.environment["RAY_AUTH_TOKEN_PATH"]).read_text()
    assert not any(secret in path.read_text(errors="replace") for path in record.parent.rglob("*") if path.is_file())

"""A node that joins while a sweep in packs runs gets a pack of its own, with trials that nobody has begun."""

import json
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.cluster.ray_nodes import Cluster
from tests.cluster.test_cluster import launch_command, node_of, read_trials

pytestmark = pytest.mark.cluster

# More than one pack trains at once, so that some wait; steps that wait cost nothing.
NUM_TRIALS = 66
SWEEP = {
    "algorithm": "ppo",
    "space": {"lr": {"uniform": [1e-3, 2e-3]}},
    "num_samples": NUM_TRIALS,
    "hyperparams": {"num_envs": 1, "train_batch_size": 64, "minibatch_size": 64, "num_epochs": 1, "hidden_sizes": [8]},
    "stop": {"num_env_steps": 128},
    "evaluation": {"every_iterations": 2, "num_episodes": 1},
    "confirm": "none",
}


@pytest.fixture
def cluster(env_plugin: None, tmp_path: Path) -> Iterator[Cluster]:
    cluster = Cluster(tmp_path)
    try:
        cluster.start_head()
        yield cluster
    finally:
        cluster.stop()


def wait_for_packs(folder: Path, names: list[str], process: subprocess.Popen[str]) -> None:
    """Wait until these packs, and no others, have trials, and some run."""
    deadline = time.monotonic() + 300
    while True:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        files = sorted((folder / "packs").glob("p*.json"))
        with_trials = [path.stem for path in files if json.loads(path.read_text())["trial_ids"]]
        if with_trials == names and any(trial["status"] == "running" for trial in read_trials(folder)):
            return
        time.sleep(0.2)


def test_trials_that_wait_are_trained_on_a_node_that_joins(cluster: Cluster, tmp_path: Path) -> None:
    slow = tmp_path / "slow"
    slow.touch()
    env = {"id": "TestTrouble-v0", "args": {"pause_s": 0.1, "pause_while": str(slow)}}
    spec = tmp_path / "sweep.yaml"
    spec.write_text(yaml.safe_dump({**SWEEP, "env": env}))
    folder = tmp_path / "storage" / "swept"
    process = cluster.begin(launch_command(spec, folder.parent, cluster.address))
    try:
        wait_for_packs(folder, ["p00"], process)
        joined = cluster.start_worker("joined")
        wait_for_packs(folder, ["p00", "p01"], process)
        slow.unlink()
        _, stderr = process.communicate(timeout=300)
    finally:
        process.kill()
    assert process.returncode == 0, stderr
    trials = read_trials(folder)
    assert [trial["status"] for trial in trials] == ["completed"] * NUM_TRIALS
    assert [trial["num_failures"] for trial in trials] == [0] * NUM_TRIALS
    there = [trial["index"] for trial in trials if node_of(trial) == joined.node_id[:8]]
    assert there
    # Those that had begun stayed where they were.
    assert min(there) >= NUM_TRIALS // 2

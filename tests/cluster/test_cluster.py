"""One sweep over several Ray nodes, each a process of its own on this machine, with token authentication on."""

import contextlib
import json
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.cluster.ray_nodes import BIN, Cluster, Node

pytestmark = pytest.mark.cluster

SWEEP = {
    "env": "CartPole-v1",
    "algorithm": "ppo",
    "space": {"lr": {"grid": [1e-3, 2e-3, 3e-3, 4e-3]}},
    "hyperparams": {"num_envs": 8, "train_batch_size": 1024, "minibatch_size": 512, "num_epochs": 2},
    # In two packs, which ask for a CPU each at once: one on each node, however short the trials.
    "stop": {"num_env_steps": 6_000},
    "evaluation": {"every_iterations": 5, "num_episodes": 2},
    "checkpoints": {"every_iterations": 3},
}


@pytest.fixture(scope="module")
def cluster(env_plugin: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    cluster = Cluster(tmp_path_factory.mktemp("cluster"))
    try:
        cluster.start_head()
        yield cluster
    finally:
        cluster.stop()


@pytest.fixture(scope="module")
def worker(cluster: Cluster) -> Node:
    """A second node, with a CPU as the head has one."""
    return cluster.start_worker("worker")


@pytest.fixture(scope="module")
def stranger(cluster: Cluster) -> Iterator[subprocess.Popen[str]]:
    """A launch with another token, begun early: Ray tries for 20 s before it gives up."""
    token = cluster.folder / "another-token"
    token.touch(mode=0o600)
    token.write_text("0" * 64)
    spec = write_sweep(cluster.folder)
    command = launch_command(spec, cluster.folder / "strange", cluster.address)
    process = cluster.begin(command, RAY_AUTH_TOKEN_PATH=str(token))
    yield process
    process.kill()
    process.communicate()


@pytest.fixture
def storage(tmp_path: Path) -> Path:
    folder = tmp_path / "storage"
    folder.mkdir()
    return folder


def write_sweep(folder: Path, **changes: Any) -> Path:
    path = folder / "sweep.yaml"
    path.write_text(yaml.safe_dump({**SWEEP, **changes}))
    return path


def launch_command(spec: Path, storage: Path, address: str) -> list[str | Path]:
    return [
        BIN / "tune-jobs", "launch", spec, "--name", "swept", "--storage", storage, "--address", address, "--no-finish",
    ]  # fmt: skip


def read_trials(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(path.read_text()) for path in sorted(folder.glob("trials/*/trial.json"))]


def node_of(trial: dict[str, Any]) -> str:
    """The id, as far as the record has it, of the node that the trial last ran on."""
    return str(trial["node"]).partition("/")[2]


def result_lines(folder: Path, trial_id: str, up_to: int) -> list[str]:
    lines = (folder / "trials" / trial_id / "results.jsonl").read_text().splitlines()
    return [line for line in lines if json.loads(line)["iteration"] <= up_to]


class BadNode:
    """A node without CPUs that is made unfit in one way after another: each launch asks it by a new process.

    Args:
        node: The node, with `site` first on its path.
        site: A folder.
        has_mounts: Whether it has mounts of its own, which nobody else sees.
    """

    def __init__(self, node: Node, site: Path, has_mounts: bool) -> None:
        self.node, self.site, self.has_mounts = node, site, has_mounts

    @contextlib.contextmanager
    def unfit(self, kind: str, storage: Path) -> Iterator[None]:
        """In the block it can't take part."""
        if kind == "without_tune_jobs":
            (self.site / "sitecustomize.py").write_text(HIDE_TUNE_JOBS)
        elif kind == "other_version":
            for name, other in OTHER_VERSIONS.items():
                folder = self.site / f"{name.replace('-', '_')}-{other}.dist-info"
                folder.mkdir()
                (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {other}\n")
        elif not self.has_mounts:
            pytest.skip("mount namespaces are not available here: `unshare -m` fails")
        elif kind == "storage_not_shared":
            self._mount(f"mount -t tmpfs none '{storage}'")
        else:
            self._mount(f"mount --bind '{storage}' '{storage}'; mount -o remount,bind,ro '{storage}'")
        yield
        for path in self.site.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def _mount(self, script: str) -> None:
        target = f"--target={self.node.process.pid}"
        user = [] if os.geteuid() == 0 else ["--user", "--preserve-credentials"]
        subprocess.run(["nsenter", target, "--mount", *user, "sh", "-ec", script], check=True)


@pytest.fixture(scope="class")
def bad_node(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[BadNode]:
    site = tmp_path_factory.mktemp("site")
    unshare = ["unshare", "-m"] if os.geteuid() == 0 else ["unshare", "-rm"]
    try:
        has_mounts = subprocess.run([*unshare, "true"], capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        has_mounts = False
    node = cluster.start_worker(
        "bad", num_cpus=0, prefix=unshare if has_mounts else [], environment={"PYTHONPATH": str(site)}
    )
    yield BadNode(node, site, has_mounts)
    node.stop()


OTHER_VERSIONS = {"tune-jobs": "99.9", "torch": "1.0+cu1", "numpy": "1.1"}
BAD_NODES = {
    "storage_not_shared": "does not see the sweep folder",
    "storage_read_only": "cannot write in the sweep folder",
    "without_tune_jobs": "has no working tune-jobs: ModuleNotFoundError: No module named 'tune_jobs'",
    "other_version": "has tune-jobs 99.9",
}


class TestANodeThatCannotTakePart:
    """One node, in a class that it ends with; before the tests that need a second one, which would be asked too."""

    @pytest.mark.parametrize("kind", BAD_NODES)
    def test_it_is_named_before_anything_starts(
        self, cluster: Cluster, bad_node: BadNode, tmp_path: Path, storage: Path, kind: str
    ) -> None:
        with bad_node.unfit(kind, storage):
            done = cluster.run(launch_command(write_sweep(tmp_path), storage, cluster.address))
        assert done.returncode == 5, done.stderr
        assert done.stderr.startswith("error: Node ")
        assert f"node {bad_node.node.node_id[:8]})" in done.stderr.splitlines()[0]
        assert BAD_NODES[kind] in done.stderr
        if kind == "other_version":
            assert "has torch 1.0+cu1" in done.stderr
            assert f"has numpy 1.1, {socket.gethostname()} has {version('numpy')}" in done.stderr
        assert "Traceback" not in done.stderr
        assert list(storage.iterdir()) == []


HIDE_TUNE_JOBS = """
import sys


class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("tune_jobs", "policies", "analysis"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


sys.meta_path.insert(0, Hidden())
"""


def test_a_client_runs_a_sweep_on_every_node(
    cluster: Cluster, worker: Node, stranger: subprocess.Popen[str], tmp_path: Path, storage: Path
) -> None:
    done = cluster.run(launch_command(write_sweep(tmp_path), storage, cluster.client_address))
    assert done.returncode == 0, done.stderr
    trials = read_trials(storage / "swept")
    assert [trial["status"] for trial in trials] == ["completed"] * 4
    assert all(trial["num_env_steps"] >= 6_000 for trial in trials)
    assert {node_of(trial) for trial in trials} == {cluster.nodes["head"].node_id[:8], worker.node_id[:8]}
    assert "4 completed" in done.stderr
    sweep = json.loads((storage / "swept" / "sweep.json").read_text())
    assert (sweep["state"], sweep["address"]) == ("completed", cluster.client_address)


# Steps that wait cost nothing, and leave the time to see a checkpoint and end a node.
SLOW: dict[str, Any] = {
    "space": {"lr": {"grid": [1e-3, 2e-3, 3e-3]}},
    "hyperparams": {"num_envs": 8, "train_batch_size": 128, "minibatch_size": 64, "num_epochs": 2},
    "stop": {"num_env_steps": 3_000},
}


@pytest.mark.parametrize("case", ["rllib-crash", "packed-crash", "packed-drain", "rllib-drain"])
def test_a_trial_goes_on_elsewhere_when_its_node_is_lost(
    cluster: Cluster, worker: Node, tmp_path: Path, storage: Path, case: str
) -> None:
    engine, _, how = case.partition("-")
    # Each of the two ways in which a machine of the cluster joins it.
    address = {"rllib": "auto", "packed": cluster.address}[engine]
    doomed = cluster.start_worker("doomed")
    doomed_id = doomed.node_id
    slow = tmp_path / "slow"
    slow.touch()
    env = {"id": "TestTrouble-v0", "args": {"pause_s": 0.005, "pause_while": str(slow)}}
    # No failure is forgiven, and the loss of a node is none.
    spec = write_sweep(tmp_path, **SLOW, env=env, engine=engine, max_retries=0)
    process = cluster.begin(launch_command(spec, storage, address))
    folder = storage / "swept"
    try:
        lost = wait_for_checkpoint_on(doomed_id, folder, process, SLOW["stop"]["num_env_steps"])
        if how == "crash":
            doomed.crash()
        else:
            wait_until_it_left(cluster, doomed, folder / "trials" / lost)
        slow.unlink()
        iteration = max(int(path.name) for path in (folder / "trials" / lost / "checkpoints").glob("0*"))
        before = result_lines(folder, lost, iteration)
        _, stderr = process.communicate(timeout=400)
    finally:
        process.kill()
    assert process.returncode == 0, stderr
    assert "3 completed" in stderr
    sweep = json.loads((folder / "sweep.json").read_text())
    assert (sweep["state"], sweep["address"]) == ("completed", address)
    trials = {trial["trial_id"]: trial for trial in read_trials(folder)}
    assert [trial["status"] for trial in trials.values()] == ["completed"] * 3
    assert all(trial["num_env_steps"] >= SLOW["stop"]["num_env_steps"] for trial in trials.values())
    # On every node: the others were on those that are left.
    ids = {cluster.nodes["head"].node_id[:8], worker.node_id[:8]}
    assert {node_of(trial) for name, trial in trials.items() if name != lost} == ids
    assert node_of(trials[lost]) in ids
    assert [trial["num_failures"] for trial in trials.values()] == [0] * 3
    [note] = trials[lost]["notes"]
    assert f"({doomed_id[:8]}) was {'lost' if how == 'crash' else 'drained'}." in note
    # The lines hold times to the microsecond: iterations that were trained again would have others.
    assert len(before) == iteration
    assert result_lines(folder, lost, iteration) == before


def wait_until_it_left(cluster: Cluster, node: Node, trial: Path) -> None:
    """Drain a node, as before a spot machine is taken away, until its trial has saved and goes on elsewhere."""
    cluster.drain(node)
    deadline = time.monotonic() + 120
    while "was drained" not in (trial / "trial.json").read_text():
        assert time.monotonic() < deadline
        time.sleep(0.1)
    record = json.loads((trial / "trial.json").read_text())
    newest = max(int(path.name) for path in (trial / "checkpoints").glob("0*"))
    # Nothing that it has told of is trained again.
    assert newest >= record["num_iterations"]
    node.crash()


def wait_for_checkpoint_on(node_id: str, folder: Path, process: subprocess.Popen[str], num_env_steps: int) -> str:
    """The trial that runs on a node, once it has a checkpoint; before its last iterations."""
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        assert process.poll() is None, process.communicate()
        for trial in read_trials(folder):
            if trial["status"] != "running" or not trial["node"] or node_of(trial) != node_id[:8]:
                continue
            if any((folder / "trials" / trial["trial_id"] / "checkpoints").glob("0*")):
                assert trial["num_env_steps"] < 0.8 * num_env_steps, "too late: the trial is nearly done"
                return str(trial["trial_id"])
        time.sleep(0.1)
    raise AssertionError("no trial ran on the node")


def test_more_than_the_nodes_have_is_refused_with_the_numbers(cluster: Cluster, tmp_path: Path, storage: Path) -> None:
    spec = write_sweep(tmp_path, resources={"num_env_runners": 7})
    done = cluster.run(launch_command(spec, storage / "new", cluster.address))
    assert done.returncode == 5, done.stderr
    assert "8 CPUs" in done.stderr
    assert list(storage.iterdir()) == []


def test_another_token_is_refused(cluster: Cluster, stranger: subprocess.Popen[str]) -> None:
    _, stderr = stranger.communicate(timeout=400)
    assert stranger.returncode == 5, stderr
    assert f"The Ray cluster at {cluster.address} does not accept this machine's token." in stderr
    assert "RAY_AUTH_TOKEN" in stderr
    assert "gcs_client" not in stderr
    assert not (cluster.folder / "strange").exists()

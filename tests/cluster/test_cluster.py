"""One sweep over several Ray nodes, each a process of its own on this machine, with token authentication on."""

import json
import os
import subprocess
import time
from pathlib import Path

import pytest
import yaml
from ray_nodes import BIN, Cluster

pytestmark = pytest.mark.cluster

SWEEP = {
    "env": "CartPole-v1",
    "algorithm": "ppo",
    "space": {"lr": {"grid": [1e-3, 2e-3, 3e-3, 4e-3]}},
    "hyperparams": {"num_envs": 8, "train_batch_size": 1024, "minibatch_size": 512, "num_epochs": 2},
    # Long enough that a node which is some seconds slower to start still finds a trial left.
    "stop": {"num_env_steps": 30_000},
    "evaluation": {"every_iterations": 5, "num_episodes": 2},
    "checkpoints": {"every_iterations": 3},
}


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    cluster = Cluster(tmp_path_factory.mktemp("cluster"))
    try:
        cluster.start_head()
        cluster.start_worker("worker")
        yield cluster
    finally:
        cluster.stop()


@pytest.fixture(scope="module")
def stranger(cluster):
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
def storage(tmp_path):
    folder = tmp_path / "storage"
    folder.mkdir()
    return folder


def write_sweep(folder: Path, **changes) -> Path:
    path = folder / "sweep.yaml"
    path.write_text(yaml.safe_dump({**SWEEP, **changes}))
    return path


def launch_command(spec: Path, storage: Path, address: str) -> list:
    return [
        BIN / "tune-jobs", "launch", spec, "--name", "swept", "--storage", storage, "--address", address, "--no-finish",
    ]  # fmt: skip


def read_trials(folder: Path) -> list[dict]:
    return [json.loads(path.read_text()) for path in sorted(folder.glob("trials/*/trial.json"))]


def node_of(trial: dict) -> str:
    """The id, as far as the record has it, of the node that the trial last ran on."""
    return trial["node"].partition("/")[2]


def result_lines(folder: Path, trial_id: str, up_to: int) -> list[str]:
    lines = (folder / "trials" / trial_id / "results.jsonl").read_text().splitlines()
    return [line for line in lines if json.loads(line)["iteration"] <= up_to]


@pytest.mark.parametrize("kind", ["auto", "client"])
def test_a_sweep_runs_on_every_node(cluster, stranger, tmp_path, storage, kind):
    address = {"auto": "auto", "client": cluster.client_address}[kind]
    done = cluster.run(launch_command(write_sweep(tmp_path), storage, address))
    assert done.returncode == 0, done.stderr
    trials = read_trials(storage / "swept")
    assert [trial["status"] for trial in trials] == ["completed"] * 4
    assert all(trial["num_env_steps"] >= 30_000 for trial in trials)
    ids = cluster.node_ids()
    assert {node_of(trial) for trial in trials} == {ids["head"][:8], ids["worker"][:8]}
    assert "4 completed" in done.stderr
    sweep = json.loads((storage / "swept" / "sweep.json").read_text())
    assert (sweep["state"], sweep["address"]) == ("completed", address)


# A pack of one trains several times as many env steps in the time it takes to see a checkpoint and end a node.
@pytest.mark.parametrize(("engine", "num_env_steps"), [("rllib", 60_000), ("packed", 400_000)])
def test_a_trial_goes_on_elsewhere_when_its_node_is_lost(cluster, tmp_path, storage, engine, num_env_steps):
    doomed = cluster.start_worker("doomed")
    ids = cluster.node_ids()
    space, stop = {"lr": {"grid": [1e-3, 2e-3, 3e-3]}}, {"num_env_steps": num_env_steps}
    spec = write_sweep(tmp_path, space=space, stop=stop, engine=engine)
    process = cluster.begin(launch_command(spec, storage, cluster.address))
    folder = storage / "swept"
    try:
        lost = wait_for_checkpoint_on(ids["doomed"], folder, process, num_env_steps)
        doomed.crash()
        iteration = max(int(path.name) for path in (folder / "trials" / lost / "checkpoints").glob("0*"))
        before = result_lines(folder, lost, iteration)
        _, stderr = process.communicate(timeout=400)
    finally:
        process.kill()
    assert process.returncode == 0, stderr
    trials = {trial["trial_id"]: trial for trial in read_trials(folder)}
    assert {trial["status"] for trial in trials.values()} == {"completed"}
    assert node_of(trials[lost]) in {ids["head"][:8], ids["worker"][:8]}
    assert [trial["num_failures"] for name, trial in trials.items() if name == lost] == [1]
    # The lines hold times to the microsecond: iterations that were trained again would have others.
    assert len(before) == iteration
    assert result_lines(folder, lost, iteration) == before


def wait_for_checkpoint_on(node_id: str, folder: Path, process: subprocess.Popen, num_env_steps: int) -> str:
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


def _in_mount_namespace(script: str) -> list[str]:
    """A command that runs a shell script, which alone sees its own mounts, and then its arguments."""
    unshare = ["unshare", "-m"] if os.geteuid() == 0 else ["unshare", "-rm"]
    try:
        allowed = subprocess.run([*unshare, "true"], capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        allowed = False
    if not allowed:
        pytest.skip("mount namespaces are not available here: `unshare -m` fails")
    return [*unshare, "sh", "-ec", f'{script}; exec "$@"', "sh"]


BAD_NODES = {
    "storage_not_shared": "does not see the sweep folder",
    "storage_read_only": "Read-only file system",
    "without_tune_jobs": "has no tune-jobs that works: ModuleNotFoundError: No module named 'tune_jobs'",
    "other_version": "has tune-jobs 99.9",
}


@pytest.mark.parametrize("kind", BAD_NODES)
def test_a_node_that_cannot_take_part_is_named_before_anything_starts(cluster, tmp_path, storage, kind):
    site = tmp_path / "site"
    site.mkdir()
    prefix: list[str] = []
    if kind == "storage_not_shared":
        prefix = _in_mount_namespace(f"mount -t tmpfs none '{storage}'")
    elif kind == "storage_read_only":
        prefix = _in_mount_namespace(f"mount --bind '{storage}' '{storage}'; mount -o remount,bind,ro '{storage}'")
    elif kind == "without_tune_jobs":
        (site / "sitecustomize.py").write_text(HIDE_TUNE_JOBS)
    else:
        (site / "tune_jobs-99.9.dist-info").mkdir()
        (site / "tune_jobs-99.9.dist-info" / "METADATA").write_text(
            "Metadata-Version: 2.1\nName: tune-jobs\nVersion: 99.9\n"
        )
    bad = cluster.start_worker("bad", num_cpus=0, prefix=prefix, environment={"PYTHONPATH": str(site)})
    try:
        node_id = cluster.node_ids()["bad"]
        done = cluster.run(launch_command(write_sweep(tmp_path), storage, cluster.address))
    finally:
        bad.stop()
    assert done.returncode == 5, done.stderr
    assert done.stderr.startswith("error: Node ")
    assert f"node {node_id[:8]})" in done.stderr.splitlines()[0]
    assert BAD_NODES[kind] in done.stderr
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


def test_more_than_the_nodes_have_is_refused_with_the_numbers(cluster, tmp_path, storage):
    spec = write_sweep(tmp_path, resources={"num_env_runners": 7})
    done = cluster.run(launch_command(spec, storage / "new", cluster.address))
    assert done.returncode == 5, done.stderr
    assert "8 CPUs" in done.stderr
    assert list(storage.iterdir()) == []


def test_another_token_is_refused(cluster, stranger):
    _, stderr = stranger.communicate(timeout=400)
    assert stranger.returncode == 5, stderr
    assert f"The Ray cluster at {cluster.address} does not accept this machine's token." in stderr
    assert "RAY_AUTH_TOKEN" in stderr
    assert "gcs_client" not in stderr
    assert not (cluster.folder / "strange").exists()

"""Sweeps on a cluster that has no node but its head, whose autoscaler starts up to three on this machine.

    python -m tests.cluster.autoscaled FOLDER

Ray's autoscaler for tests ends nodes by itself, so this runs in namespaces of its own (`test_autoscaled_cluster`),
where no other Ray is. It prints one JSON document: what each sweep said, and the most that it asked for and got.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import yaml

from tests.cluster.ray_nodes import BIN, OBJECT_STORE_BYTES, Cluster

PROVIDER = "ray.autoscaler._private.fake_multi_node.node_provider.FakeMultiNodeProvider"
MOST_NODES = 3
PATIENCE_S = 120.0
SWEEP = {
    "env": "CartPole-v1",
    "algorithm": "ppo",
    "engine": "rllib",
    "space": {"lr": {"loguniform": [1e-3, 1e-2]}},
    "num_samples": 2,
    "hyperparams": {"num_envs": 2, "train_batch_size": 256, "minibatch_size": 128, "num_epochs": 1},
    "stop": {"num_env_steps": 20_000},
    "evaluation": {"every_iterations": 20, "num_episodes": 1},
    "confirm": "none",
}
PACKED = {
    **SWEEP,
    "engine": "packed",
    # More than one pack trains at once, and not as many as three do.
    "num_samples": 66,
    "hyperparams": {"num_envs": 1, "train_batch_size": 64, "minibatch_size": 64, "num_epochs": 1, "hidden_sizes": [8]},
    "stop": {"num_env_steps": 1_000_000},
}


def autoscaling(folder: Path, address: str) -> Path:
    """Ray's configuration of an autoscaler, with all that it asks for."""
    names = (
        "initialization_commands", "setup_commands", "head_setup_commands", "worker_setup_commands",
        "head_start_ray_commands", "worker_start_ray_commands", "cluster_synced_files", "rsync_exclude", "rsync_filter",
    )  # fmt: skip
    small = {"CPU": 1, "object_store_memory": OBJECT_STORE_BYTES}
    config = {
        "cluster_name": "tested",
        "provider": {
            "type": "external", "module": PROVIDER, "gcs_address": address, "use_node_id_as_ip": True,
            "disable_node_updaters": True, "disable_launch_config_check": True,
        },
        "max_workers": 8,
        "available_node_types": {
            "ray.head.default": {"resources": {"CPU": 0}, "node_config": {}, "max_workers": 0},
            "small": {"resources": small, "node_config": {}, "min_workers": 0, "max_workers": MOST_NODES},
        },
        "head_node_type": "ray.head.default",
        "idle_timeout_minutes": 0.2,
        "upscaling_speed": 1.0,
        "auth": {},
        "docker": {},
        "file_mounts": {},
        "file_mounts_sync_continuously": False,
        **{name: [] for name in names},
    }  # fmt: skip
    path = folder / "autoscaling.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


class Watched:
    """What the cluster has, looked at again and again."""

    def __init__(self) -> None:
        # Ray reads the token when it is imported.
        import ray

        self._ray = ray
        self.most_nodes = self.most_asked = 0

    def num_nodes(self) -> int:
        found: int = sum(node["Alive"] and bool(node["Resources"].get("CPU")) for node in self._ray.nodes())
        self.most_nodes = max(self.most_nodes, found)
        self.most_asked = max(self.most_asked, self.groups().total())
        return found

    def groups(self) -> Counter[str]:
        """The groups of resources that were asked for, by their state."""
        table = self._ray.util.placement_group_table().values()
        return Counter(group["state"] for group in table if group["state"] != "REMOVED")

    def until(self, is_so: Any, patience_s: float = PATIENCE_S) -> bool:
        deadline = time.monotonic() + patience_s
        while time.monotonic() < deadline:
            self.num_nodes()
            if is_so():
                return True
            time.sleep(0.2)
        return False


def begin(cluster: Cluster, name: str, spec: dict[str, Any]) -> subprocess.Popen[str]:
    path = cluster.folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(spec))
    words = [
        "launch", path, "--name", name, "--storage", cluster.folder / "sweeps", "--address", cluster.address,
        "--wait-for-nodes", PATIENCE_S, "--no-finish",
    ]  # fmt: skip
    return cluster.begin([BIN / "tune-jobs", *map(str, words)])


def told(process: subprocess.Popen[str], watched: Watched) -> dict[str, Any]:
    """Wait for the end of a launch; return what it said, and what was left."""
    ended = watched.until(lambda: process.poll() is not None, 2 * PATIENCE_S)
    if not ended:
        process.kill()
    _, stderr = process.communicate()
    return {"code": process.returncode, "said": stderr, **left(watched)}


def left(watched: Watched) -> dict[str, Any]:
    is_withdrawn = watched.until(lambda: not watched.groups(), 20)
    is_small_again = watched.until(lambda: watched.num_nodes() == 0)
    return {
        "most_nodes": watched.most_nodes, "most_asked": watched.most_asked,
        "is_withdrawn": is_withdrawn, "is_small_again": is_small_again,
    }  # fmt: skip


def too_large(cluster: Cluster) -> dict[str, Any]:
    began = time.monotonic()
    found = told(begin(cluster, "large", {**SWEEP, "resources": {"num_cpus": 2}}), Watched())
    return {**found, "took_s": time.monotonic() - began, "is_kept": (cluster.folder / "sweeps" / "large").exists()}


def killed(cluster: Cluster) -> dict[str, Any]:
    """A driver that is killed while its packs train on all nodes that it can use."""
    watched = Watched()
    process = begin(cluster, "packed", PACKED)
    packs = cluster.folder / "sweeps" / "packed" / "packs"

    def train() -> bool:
        files = list(packs.glob("p*.json"))
        with_trials = [path for path in files if json.loads(path.read_text())["trial_ids"]]
        return process.poll() is not None or (len(with_trials) == 2 and watched.num_nodes() == 2)

    is_training = watched.until(train)
    # For what could still come if it asked for more.
    watched.until(lambda: False, 8)
    is_running = process.poll() is None
    os.kill(process.pid, signal.SIGKILL)
    _, stderr = process.communicate()
    return {"is_training": is_training and is_running, "said": stderr, **left(watched)}


def main(folder: Path) -> None:
    cluster = Cluster(folder)
    config = autoscaling(folder, cluster.address)
    environment = {"RAY_FAKE_CLUSTER": "1", "AUTOSCALER_UPDATE_INTERVAL_S": "1"}
    try:
        cluster.start_head(num_cpus=0, options=[f"--autoscaling-config={config}"], environment=environment)
        os.environ.update(cluster.environment)
        import ray

        ray.init(address=cluster.address, log_to_driver=False, logging_level="error")
        found = {"large": too_large(cluster), "killed": killed(cluster)}
        found["single"] = told(begin(cluster, "single", SWEEP), Watched())
        ray.shutdown()
    finally:
        cluster.stop()
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))

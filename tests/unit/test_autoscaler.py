"""Which nodes a cluster's autoscaler may add, as it is known on the head; Ray's answers are made here."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from tune_jobs.ray_tune import autoscaler
from tune_jobs.ray_tune.autoscaler import NodeType, node_types

HEAD = {"NodeID": "5" * 56, "Resources": {"node:__internal_head__": 1.0}}
CONFIG: dict[str, Any] = {
    "max_workers": 4,
    "head_node_type": "head",
    "available_node_types": {
        "head": {"resources": {"CPU": 64}},
        "small": {"resources": {"CPU": 2, "memory": 1e9}, "max_workers": 3},
        "gpu": {"resources": {"CPU": 8, "GPU": 1}},
        "none": {"resources": {"CPU": 96}, "max_workers": 0},
    },
}


@pytest.fixture(autouse=True)
def cluster(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A cluster whose head is this machine, where the question is answered in this process."""
    found = SimpleNamespace(config=None, nodes=[HEAD])
    question = autoscaler._question()
    task: Any = SimpleNamespace(options=lambda **_: task, remote=lambda: None)
    monkeypatch.setattr(autoscaler, "alive_nodes", lambda: found.nodes)
    monkeypatch.setattr("ray.remote", lambda **_: lambda _: task)
    monkeypatch.setattr("ray.get", lambda *_, **__: question())
    monkeypatch.setattr("ray.get_runtime_context", lambda: SimpleNamespace(gcs_address="10.0.0.1:6379"))
    monkeypatch.setattr("ray._private.state.state", SimpleNamespace(get_cluster_config=lambda: found.config))
    return found


@pytest.fixture
def monitor(tmp_path: Path) -> Iterator[Callable[..., None]]:
    """Starts a process that is called as Ray's monitor is, with a configuration."""
    begun: list[subprocess.Popen[bytes]] = []

    def begin(config: Any, address: str = "10.0.0.1:6379") -> None:
        path = tmp_path / f"{address[-1]}.yaml"
        path.write_text(yaml.safe_dump(config, sort_keys=False))
        script = "import sys; print(flush=True); sys.stdin.read()"
        # As `ray start` is given it, relative to where it was started.
        words = [sys.executable, "-c", script, f"--gcs-address={address}", f"--autoscaling-config={path.name}"]
        process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=tmp_path)
        begun.append(process)
        assert process.stdout is not None
        process.stdout.readline()

    yield begin
    for process in begun:
        process.communicate()


def test_they_are_those_of_the_configuration_on_the_head(monitor: Callable[..., None]) -> None:
    monitor({**CONFIG, "available_node_types": {}}, "10.0.0.2:6378")
    monitor(CONFIG)
    assert node_types() == (NodeType("small", 2, 0, 3), NodeType("gpu", 8, 1, 4))


def test_a_head_that_there_may_be_more_of_is_one_of_them(monitor: Callable[..., None]) -> None:
    types = {"head": {"resources": {"CPU": 4}, "max_workers": 2}}
    monitor({**CONFIG, "available_node_types": types})
    assert node_types() == (NodeType("head", 4, 0, 2),)


def test_what_ray_itself_knows_is_believed(cluster: SimpleNamespace, monitor: Callable[..., None]) -> None:
    monitor(CONFIG)
    groups = [
        SimpleNamespace(name="small", resources={"CPU": 2}, max_count=3),
        SimpleNamespace(name="any", resources={"CPU": 4, "GPU": 2}, max_count=-1),
    ]
    cluster.config = SimpleNamespace(node_group_configs=groups)
    small, unlimited = node_types()
    assert small == NodeType("small", 2, 0, 3)
    assert unlimited[:3] == ("any", 4, 2)
    assert unlimited.most > 100_000


@pytest.mark.parametrize(
    "config",
    [
        None,
        {**CONFIG, "available_node_types": {"cloud": {"max_workers": 3}}},
        {"provider": {"type": "local"}},
        ["no", "mapping"],
    ],
    ids=["no autoscaler", "resources that the cloud knows", "no types", "another file"],
)
def test_nothing_is_known_where_it_does_not_say(monitor: Callable[..., None], config: Any) -> None:
    if config is not None:
        monitor(config)
    assert node_types() == ()


def test_nothing_is_known_without_a_head(cluster: SimpleNamespace, monitor: Callable[..., None]) -> None:
    monitor(CONFIG)
    cluster.nodes = [{"NodeID": "6" * 56, "Resources": {"CPU": 4.0}}]
    assert node_types() == ()

"""A Ray that is started for sweeps of this machine has no processes that nobody asks anything."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import ray._private.node
from live_service import wait_until
from ray._private import services
from ray.tune.execution import class_cache

from policies.errors import CannotRunError
from tests.narrowing import present
from tune_jobs.plan.machine import Machine
from tune_jobs.ray_tune import idle_agent
from tune_jobs.ray_tune.cluster import connect
from tune_jobs.ray_tune.local_ray import without_dashboards_agent, without_environments

UNUSED = ("start_monitor", "start_log_monitor", "start_api_server")
NODE: Any = ray._private.node.Node


def test_those_are_not_started_and_another_ray_of_this_process_has_them(monkeypatch: pytest.MonkeyPatch) -> None:
    before = [getattr(NODE, name) for name in UNUSED]  # a Ray in which they have other names is noticed here
    started: list[object] = []

    def init(**_: Any) -> None:
        node = NODE.__new__(NODE)
        started.extend(getattr(node, name)(include_dashboard=False, raise_on_failure=False) for name in UNUSED)
        raise RuntimeError("far enough")

    monkeypatch.setattr("ray.is_initialized", lambda: False)
    monkeypatch.setattr("ray.init", init)
    with pytest.raises(CannotRunError, match="far enough"), connect(None, Machine(num_cpus=1, num_gpus=0)):
        pass
    assert started == [None, None, None]
    assert [getattr(NODE, name) for name in UNUSED] == before


def test_the_dashboards_agent_is_replaced_in_the_raylets_command_alone() -> None:
    # That Ray's command is like this, test_interruption.py sees by the processes of a real one.
    started: list[list[str]] = []
    with mock.patch.object(services, "start_ray_process", lambda command, *_, **__: started.append(command)):
        real = services.start_ray_process
        with without_dashboards_agent():
            services.start_ray_process(["gcs_server", "--a=b"], "gcs_server")
            services.start_ray_process(["raylet", "--dashboard_agent_command=python -u /ray/dashboard/agent.py --x=1"])
            services.start_ray_process(["raylet", "--dashboard_agent_command=another"])
        assert services.start_ray_process is real
    program = Path(idle_agent.__file__)
    assert started[0] == ["gcs_server", "--a=b"]
    assert started[1] == ["raylet", f"--dashboard_agent_command={sys.executable} -I -S {program} --x=1"]
    assert started[2] == ["raylet", "--dashboard_agent_command=another"]


def test_the_agent_says_that_it_listens_nowhere_and_ends_with_its_parent(tmp_path: Path) -> None:
    node = "a1" * 28
    command = [sys.executable, idle_agent.__file__, f"--session-dir={tmp_path}", f"--node-id={node}", "--head"]
    # Its parent is a process that ends when its input does.
    script = """if True:
        import subprocess, sys
        print(subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL).pid, flush=True)
        sys.stdin.read()
    """
    parent = subprocess.Popen(
        [sys.executable, "-c", script, *command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    pid = int(present(parent.stdout).readline())
    names = [f"{name}_{node}" for name in ("dashboard_agent_listen_port", "metrics_agent_port", "metrics_export_port")]
    wait_until(lambda: sorted(path.name for path in tmp_path.iterdir()) == names)
    assert {(tmp_path / name).read_text() for name in names} == {"-1"}
    assert runs(pid)
    parent.communicate("")
    wait_until(lambda: not runs(pid))


def test_tunes_actors_need_no_environment_so_that_processes_that_wait_can_be_theirs() -> None:
    class Trains:
        pass

    def environment() -> object:
        return class_cache._ActorClassCache().get(Trains)._default_options.get("runtime_env")

    assert environment()  # where Tune has none any more, this is of no use
    with without_environments():
        assert not environment()
    assert environment()


def runs(pid: int) -> bool:
    """Not one that has ended and that nobody has asked how."""
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] not in "ZX"

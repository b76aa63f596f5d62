"""A Ray that is started for sweeps of this machine has no processes that nobody asks anything."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
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
from tune_jobs.ray_tune import idle_agent, local_ray
from tune_jobs.ray_tune.cluster import connect
from tune_jobs.ray_tune.local_ray import with_python_quoted, without_dashboards_agent, without_environments

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


ODD = "My Project (a & b)"


@contextlib.contextmanager
def starting() -> Iterator[list[list[str]]]:
    """Hands out the commands by which Ray would start processes in the block."""
    started: list[list[str]] = []
    with mock.patch.object(services, "start_ray_process", lambda command, *_, **__: started.append(command)):
        yield started


def test_the_dashboards_agent_is_replaced_below_a_folder_with_a_space_too() -> None:
    command = [f"/home/me/{ODD}/bin/python", "-u", f"/home/me/{ODD}/ray/dashboard/agent.py", "--x=1", "--y=a b"]
    with starting() as started, without_dashboards_agent():
        services.start_ray_process(["raylet", f"--dashboard_agent_command={subprocess.list2cmdline(command)}"])
    program = Path(idle_agent.__file__)
    assert started[0][1] == f'--dashboard_agent_command={sys.executable} -I -S {program} --x=1 "--y=a b"'


def test_another_agent_is_told_that_what_it_needs_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> ImportError:
        return ImportError("No module named 'aiohttp'")

    monkeypatch.setattr(ray._private.utils, "get_dashboard_dependency_error", missing)
    with starting() as started, without_dashboards_agent():
        # Ray asks before it starts anything.
        assert ray._private.utils.get_dashboard_dependency_error() is None
        services.start_ray_process(["raylet", "--dashboard_agent_command=another --x=1"])
        services.start_ray_process(["raylet", "--dashboard_agent_command=python -u /ray/dashboard/agent.py --x=1"])
    assert started[0] == ["raylet", "--dashboard_agent_command=another --x=1 --minimal"]
    assert started[1][1].endswith("idle_agent.py --x=1")


@pytest.fixture
def odd_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """This Python, by a path that has to be quoted in a shell."""
    folder = tmp_path / ODD
    folder.symlink_to(sys.prefix, target_is_directory=True)
    monkeypatch.setattr(sys, "executable", str(folder / Path(sys.executable).relative_to(sys.prefix)))
    return sys.executable


@pytest.mark.parametrize("context", ["{}", '{"py_executable": "PYTHON", "env_vars": {"MINE": "1"}}'])
def test_a_process_that_is_not_forked_starts_below_a_folder_with_a_space(
    tmp_path: Path, odd_python: str, context: str
) -> None:
    program = tmp_path / "my worker.py"
    program.write_text("import os, sys\nprint(sys.executable, os.environ.get('MINE'), *sys.argv[1:], sep='\\n')\n")
    with with_python_quoted():
        # As Ray 2.60 has it, and its setup worker is given what the runtime environment's agent says.
        setup = Path(services.RAY_PATH, "_private", "workers", ray._private.ray_constants.SETUP_WORKER_FILENAME)
    options = ["--language=PYTHON", f"--serialized-runtime-env-context={context.replace('PYTHON', odd_python)}"]
    command = [odd_python, str(setup), str(program), "--a=b c", *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    expected = [odd_python, "None" if context == "{}" else "1", "--a=b c"]
    assert done.stdout.splitlines() == expected, done.stderr


def test_where_nothing_is_to_be_quoted_rays_own_program_starts_processes() -> None:
    before = ray._private.ray_constants.SETUP_WORKER_FILENAME
    with mock.patch.object(sys, "executable", "/usr/bin/python3"), with_python_quoted():
        assert before == ray._private.ray_constants.SETUP_WORKER_FILENAME


@pytest.mark.parametrize("name", ["Ann's", "a\\b"])
def test_a_path_that_no_raylet_can_read_is_named(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    def init(**_: Any) -> None:
        raise AssertionError("Ray waits half a minute for it")

    monkeypatch.setattr("ray.init", init)
    monkeypatch.setattr(sys, "executable", f"/home/me/{name}/bin/python")
    with pytest.raises(CannotRunError, match="a quote or a backslash") as caught:
        local_ray.start(Machine(1))
    assert f"from /home/me/{name}/bin/python: " in caught.value.message


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

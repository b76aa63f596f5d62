"""Processes of a local Ray that are forked from one that has imported what packs need."""

import array
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from policies.parents import is_gone
from tune_jobs.ray_tune import forked_worker, forks
from tune_jobs.ray_tune.forks import begun_ahead, fork_server

pytestmark = [pytest.mark.ray, pytest.mark.skipif(sys.platform != "linux", reason="nothing is forked elsewhere")]

ROOT = Path(__file__).parents[2]

# In the place of Ray's program: it says what it is, and stays.
PROGRAM = """\
import json, os, sys, time
import threading
import numpy, ray
drawn = []
def draw():
    drawn.append(ray.ObjectID.from_random().hex())
draw()
thread = threading.Thread(target=draw)
thread.start()
thread.join()
numpy.ones((512, 512)) @ numpy.ones((512, 512))
from policies.parents import this_process
said = {
    "me": this_process(), "options": sys.argv[1:], "path": sys.path, "folder": os.getcwd(),
    "environment": dict(os.environ), "threads": len(os.listdir("/proc/self/task")),
    "ids": drawn, "leads_its_group": os.getpgid(0) == os.getpid(), "draw": numpy.random.random(),
    "loaded": [
        name for name in ("torch", "ray", "tune_jobs.ray_tune.pack_trainable", "tune_jobs.training.rllib")
        if name in sys.modules
    ],
}
print(json.dumps(said), flush=True)
time.sleep(600)
"""
Ask = Callable[..., dict[str, Any]]


def asked(folder: Path, address: str, *options: str, **environment: str) -> dict[str, Any]:
    """Run the command that a raylet runs, and return what the process says that comes of it."""
    program, told = folder / "default_worker.py", folder / f"told-{time.monotonic_ns()}"
    program.write_text(PROGRAM)
    # What Ray's own command would do: it says that it was run.
    (folder / "setup_worker.py").write_text("print('{}')")
    command = [sys.executable, "-I", "-S", forked_worker.__file__, address]
    with told.open("wb") as file:
        subprocess.run(
            [*command, sys.executable, str(folder / "setup_worker.py"), str(program), *options],
            stdin=subprocess.DEVNULL, stdout=file, cwd=folder, env=os.environ | environment, check=True, timeout=120,
        )  # fmt: skip
    until = time.monotonic() + 60
    while not told.read_text().endswith("\n"):
        assert time.monotonic() < until, "it says nothing"
        time.sleep(0.02)
    said: dict[str, Any] = json.loads(told.read_text())
    return said


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with fork_server("packs") as found:
        assert found is not None
        yield found.address


def test_a_fork_is_what_the_command_would_have_become(address: str, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    one = asked(tmp_path, address, "--worker-id=1", PYTHONPATH=str(tmp_path / "mine"), MINE="yes")
    assert one["options"] == ["--worker-id=1"]
    assert one["path"][:2] == [str(tmp_path), str(tmp_path / "mine")]
    assert str(ROOT / "tune_jobs" / "ray_tune") not in one["path"]
    assert one["folder"] == str(tmp_path)
    assert one["environment"]["MINE"] == "yes"
    assert one["leads_its_group"]
    assert one["loaded"] == ["torch", "ray", "tune_jobs.ray_tune.pack_trainable"]
    # Another job's process is forked too.
    two = asked(tmp_path, address, "--worker-id=2", RAY_JOB_ID="02000000")
    assert "MINE" not in two["environment"]
    assert two["environment"]["RAY_JOB_ID"] == "02000000"
    assert two["draw"] != one["draw"]
    assert len({*one["ids"], *two["ids"]}) == 4
    # Nothing of it multiplies matrices in several threads; see `forking`.
    assert one["threads"] == two["threads"] == 1


def test_one_that_is_forked_for_a_single_trial_has_rllib_and_no_ids_of_another(tmp_path: Path) -> None:
    with fork_server("trials") as found:
        assert found is not None
        one, another = (asked(tmp_path, found.address) for _ in range(2))
    assert one["loaded"] == another["loaded"] == ["torch", "ray", "tune_jobs.training.rllib"]
    assert len({*one["ids"], *another["ids"]}) == 4
    assert one["threads"] == another["threads"] == 1


def test_ray_starts_a_process_itself_where_it_reads_other_settings(address: str, tmp_path: Path) -> None:
    assert asked(tmp_path, address)["loaded"]
    assert asked(tmp_path, address, RAY_something_else="1") == {}


def test_ray_starts_its_processes_itself_where_nobody_answers(tmp_path: Path) -> None:
    assert asked(tmp_path, str(tmp_path / "nobody")) == {}


def test_a_forked_process_that_who_asked_does_not_take_does_nothing(address: str, tmp_path: Path) -> None:
    """It would be a second one for one command: who asked becomes Ray's own."""
    asked(tmp_path, address)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection, (tmp_path / "told").open("wb") as told:
        connection.connect(address)
        request = {"command": [str(tmp_path / "default_worker.py")], "environment": dict(os.environ), "folder": "/",
                   "blocked": [], "ignored": [], "oom_score_adj": "0"}  # fmt: skip
        streams = array.array("i", [told.fileno()] * 3)
        connection.sendmsg([json.dumps(request).encode() + b"\n"], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, streams)])
        process = Path("/proc", connection.recv(32).decode())
        time.sleep(0.2)
        assert process.exists()
    until = time.monotonic() + 10
    while process.exists():
        assert time.monotonic() < until, "it lives on"
        time.sleep(0.02)
    assert (tmp_path / "told").read_text() == ""


def test_forked_processes_end_with_the_one_that_they_are_forked_from(tmp_path: Path) -> None:
    with fork_server("packs") as found:
        assert found is not None
        me = asked(tmp_path, found.address)["me"]
        assert not is_gone(me)
    until = time.monotonic() + 10
    while not is_gone(me):
        assert time.monotonic() < until, "it lives on"
        time.sleep(0.05)


def children() -> list[Path]:
    """What the kernel tells of each process that this one has started."""
    pids = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
    return [Path("/proc", pid) for pid in pids]


def test_ray_is_loaded_before_a_process_is_asked_for_where_one_was_announced(tmp_path: Path) -> None:
    before = children()
    with fork_server("packs") as found:
        assert found is not None
        (process,) = (each for each in children() if each not in before)
        found.announce({**os.environ, "RAY_RAYLET_PID": "7", "RAY_that_of_this_node": "1"})
        until = time.monotonic() + 60
        while "/_raylet.so" not in (process / "maps").read_text():
            assert time.monotonic() < until, "Ray is not loaded"
            time.sleep(0.05)
        of_this_node = asked(tmp_path, found.address, RAY_that_of_this_node="1", RAY_RAYLET_PID="7")
        assert of_this_node["loaded"] == ["torch", "ray", "tune_jobs.ray_tune.pack_trainable"]
        # The environment that was announced is the one that counts.
        assert asked(tmp_path, found.address) == {}


def test_who_has_ended_is_announced_nothing() -> None:
    with fork_server("packs") as found:
        assert found is not None
        found.close()
        found.announce({})


def test_one_that_still_imports_when_it_is_ended_ends_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "slow_to_import.py").write_text("import time; time.sleep(60)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setitem(forks._EARLY, "packs", ("slow_to_import",))
    monkeypatch.setattr(forks, "_PATIENCE_S", 0.2)
    before = children()
    with fork_server("packs"):
        assert len(children()) == len(before) + 1
    assert children() == before


def test_one_that_was_begun_ahead_is_the_one_that_is_used_and_lives_as_long(tmp_path: Path) -> None:
    before = children()
    with begun_ahead("packs"):
        begun = [each for each in children() if each not in before]
        assert len(begun) == 1
        with begun_ahead("packs"):  # a sweep's own, within that of who launches it
            assert [each for each in children() if each not in before] == begun
        with fork_server("packs") as found:
            assert found is not None
            assert [each for each in children() if each not in before] == begun
            assert asked(tmp_path, found.address)["loaded"]
        assert children() == before
        with fork_server("packs") as another:
            assert another is not None
            assert another.address != found.address
    assert children() == before


def test_one_that_was_begun_ahead_and_is_not_used_ends_at_once_and_leaves_no_folder() -> None:
    before = children()

    def folders() -> set[Path]:
        return set(Path(tempfile.gettempdir()).glob("tune-jobs-fork-*"))

    others = folders()
    with begun_ahead("packs"):
        begun = [each for each in children() if each not in before]
        assert len(folders() - others) == len(begun) == 1
    assert not begun[0].exists()
    assert folders() <= others


def test_none_is_begun_ahead_where_none_is_wanted() -> None:
    before = children()
    with begun_ahead(None):
        assert children() == before


def test_a_killed_driver_leaves_no_folder() -> None:
    script = """
import sys
from tune_jobs.ray_tune.forks import begun_ahead, fork_server
with fork_server("packs") as found:
    print(found.address, flush=True)
    sys.stdin.read()
"""
    with subprocess.Popen(
        [sys.executable, "-c", script], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as driver:
        assert driver.stdout is not None
        folder = Path(driver.stdout.readline().strip()).parent
        assert folder.is_dir()
        driver.kill()
    until = time.monotonic() + 60
    while folder.exists():
        assert time.monotonic() < until, "it is still there"
        time.sleep(0.1)


def test_a_local_ray_has_its_processes_forked_and_its_node_noticed() -> None:
    # In a process of its own, as this one may have joined a Ray.
    script = """
import os, threading
from pathlib import Path
import ray
from ray._private import services, state
from tune_jobs.plan.machine import Machine
from tune_jobs.ray_tune.cluster import connect

def meanwhile():
    print("meanwhile", threading.current_thread() is threading.main_thread(), ray.is_initialized())

of_ray = services.get_node

def get_node(address, node):
    known = state.GlobalState()
    known._initialize_global_state(services._get_gcs_client_options(address))
    print("the node is there", node in [each["NodeID"] for each in known.node_table()])
    return of_ray(address, node)

services.get_node = get_node

@ray.remote(num_cpus=1)
class Asked:
    def who(self):
        parent = Path(f"/proc/{os.getppid()}/cmdline").read_text()
        return parent.split("\\0")[1], ray.get_runtime_context().get_job_id()

with connect(None, Machine(num_cpus=1, num_gpus=0), meanwhile=meanwhile):
    # The first process was started before there was a job, the second for it.
    for _ in range(2):
        actor = Asked.remote()
        print(*ray.get(actor.who.remote()))
        ray.kill(actor)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False, timeout=240
    )
    program = str(ROOT / "tune_jobs" / "ray_tune" / "fork_server.py")
    first, second, *asked_whom = done.stdout.splitlines()
    assert asked_whom == [f"{program} 01000000"] * 2, done.stderr
    # Ray looks for its node once a second: it is asked when there is one.
    assert (first, second) == ("meanwhile True False", "the node is there True")

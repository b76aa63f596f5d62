"""A sweep ends in order wherever it is: while Ray starts, without its terminal, and when Ray itself dies."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ray

PROGRAM = str(Path(sys.executable).with_name("tune-jobs"))
Start = Callable[..., subprocess.Popen[str]]
# Trials that would take hours, most of them waiting while the file {slow} is there: once it is known how fast they are.
SPEC = """
env: {{id: TestTrouble-v0, args: {{pause_s: 0.005, pause_while: "{slow}"}}}}
algorithm: ppo
hyperparams: {{hidden_sizes: [8], num_envs: 4, train_batch_size: 128, minibatch_size: 64, num_epochs: 2}}
num_samples: 2
stop: {{num_env_steps: 500_000_000}}
evaluation: {{every_iterations: 2, num_episodes: 2}}
checkpoints: {{every_iterations: 2, keep: 1}}
resources: {{max_concurrent: 1}}
"""


def children(pid: int) -> dict[int, str]:
    """The command lines of a process's children, by their ids."""
    found = {}
    for listing in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in listing.read_text().split():
            try:
                found[int(child)] = Path(f"/proc/{child}/cmdline").read_text().replace("\0", " ")
            except OSError:
                continue
    return found


def child(pid: int, program: str) -> int | None:
    return next((child for child, line in children(pid).items() if program in line.split(" ")[0]), None)


def descendants(pid: int) -> dict[int, str]:
    """The command lines of all processes below one, by their ids."""
    found = children(pid)
    for child in list(found):
        found.update(descendants(child))
    return found


def named(pid: int, *programs: str) -> dict[str, int]:
    """Those of the processes below one whose first word contains a program's name, by these names."""
    lines = descendants(pid).items()
    return {name: found for name in programs for found, line in lines if name in line.split(" ")[0]}


def wait_until(condition: Callable[[], object], process: subprocess.Popen[str], limit_s: float = 240) -> None:
    deadline = time.monotonic() + limit_s
    while not condition():
        assert process.poll() is None, "it ended too early"
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.fixture
def start(env_plugin: None, tmp_path: Path) -> Iterator[Start]:
    """Launch the sweep `cut`, or go on with it, in a process, until Ray starts; whatever is left of it is ended."""
    slow = tmp_path / "slow"
    (tmp_path / "spec.yaml").write_text(SPEC.format(slow=slow))
    processes = []

    def start(*command: str, **how: Any) -> subprocess.Popen[str]:
        slow.unlink(missing_ok=True)
        how = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **how}
        process = subprocess.Popen([PROGRAM, *(command or LAUNCH)], cwd=tmp_path, text=True, **how)
        processes.append(process)
        wait_until(lambda: child(process.pid, "gcs_server"), process)
        slow.touch()
        return process

    yield start
    for process in processes:
        process.kill()
        process.wait()


LAUNCH = ("launch", "spec.yaml", "--name", "cut")


def state(folder: Path) -> str:
    return str(json.loads((folder / "sweep.json").read_text())["state"])


def half_made(folder: Path) -> set[str]:
    """The hidden files of a sweep that are there only while it runs."""
    kept = {".lock", ".driver-lock", ".owner", ".p00.owner"}
    return {path.name for path in folder.rglob(".*") if path.is_file() and "tune" not in path.parts} - kept


def checkpoints(folder: Path) -> set[str]:
    return {path.name for path in folder.glob("trials/*/checkpoints/0*")}


def has_new(folder: Path, before: set[str]) -> bool:
    return bool(checkpoints(folder) - before)


def test_a_signal_while_ray_starts(start: Start, tmp_path: Path) -> None:
    folder = tmp_path / "sweeps" / "cut"
    process = start()
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=240)
    assert process.returncode == 130, out + err
    assert err.strip().splitlines()[-1].endswith("Continue with: tune-jobs resume cut"), err
    assert state(folder) == "interrupted"
    assert half_made(folder) == set()


def test_a_terminal_that_goes_away(start: Start, tmp_path: Path) -> None:
    """As a dropped ssh line: the process gets SIGHUP, and whatever it prints from then on is an error."""
    folder = tmp_path / "sweeps" / "cut"
    ours, theirs = pty.openpty()
    # A session of its own, whose terminal this becomes as it is opened.
    name = os.ttyname(theirs)
    process = start(
        stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True, preexec_fn=lambda: os.open(name, os.O_RDWR)
    )
    os.close(theirs)
    os.set_blocking(ours, False)

    def read_and_look() -> bool:
        with contextlib.suppress(BlockingIOError):
            os.read(ours, 1 << 16)
        return bool(checkpoints(folder))

    wait_until(read_and_look, process)
    os.close(ours)
    assert process.wait(240) == 130
    assert state(folder) == "interrupted"
    trial = json.loads((folder / "trials/t0000/trial.json").read_text())
    assert trial["status"] == "paused"
    assert trial["checkpoints"][-1]["iteration"] == trial["num_iterations"]


def test_parts_of_ray_that_die_one_after_the_other(start: Start, tmp_path: Path) -> None:
    """Each time the sweep is interrupted and nothing has failed, and it goes on from there."""
    folder = tmp_path / "sweeps" / "cut"
    command: tuple[str, ...] = (*LAUNCH, "--set", "max_retries=0")
    for program, name in (("gcs_server", "control process (GCS)"), ("raylet", "raylet")):
        before = checkpoints(folder)
        process = start(*command)
        wait_until(functools.partial(has_new, folder, before), process)
        victim = child(process.pid, program)
        assert victim is not None
        os.kill(victim, signal.SIGKILL)
        # Ray's own clients give up after a minute and end the process, with code 1 and nothing saved.
        out, err = process.communicate(timeout=240)
        assert process.returncode == 5, out + err
        assert name in err
        assert "tune-jobs resume cut" in err.strip().splitlines()[-1]
        assert state(folder) == "interrupted"
        assert "failed" not in {json.loads(path.read_text())["status"] for path in folder.glob("trials/*/trial.json")}
        command = ("resume", "cut", "--no-finish")
    before = checkpoints(folder)
    process = start(*command)
    wait_until(functools.partial(has_new, folder, before), process)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=240)
    assert process.returncode == 130, out + err
    statuses = {json.loads(path.read_text())["status"] for path in folder.glob("trials/*/trial.json")}
    assert statuses <= {"paused", "pending"}


def assert_interrupted(process: subprocess.Popen[str], folder: Path) -> None:
    """Nothing is said of Ray's death, and the sweep can go on."""
    out, err = process.communicate(timeout=240)
    assert process.returncode == 130, out + err
    assert err.strip().splitlines()[-1] == ("Interrupted; what is done is kept. Continue with: tune-jobs resume cut"), (
        err
    )
    assert "died" not in err
    assert state(folder) == "interrupted"
    # Two trials' first checkpoints, and a Ray before them, take longer.
    assert 0.5 < json.loads((folder / "sweep.json").read_text())["run_time_s"] < 240
    statuses = {json.loads(path.read_text())["status"] for path in folder.glob("trials/*/trial.json")}
    assert statuses <= {"paused", "pending"}


@pytest.mark.parametrize("dies", ["", "raylet"])
def test_a_signal_to_all_processes_is_an_interruption(start: Start, tmp_path: Path, dies: str) -> None:
    """As `timeout`, Slurm and systemd send it: Ray's own processes may end before the sweep has."""
    folder = tmp_path / "sweeps" / "cut"
    process = start(start_new_session=True)
    wait_until(functools.partial(has_new, folder, set()), process)
    victim = child(process.pid, dies) if dies else None
    if victim is not None:
        os.kill(victim, signal.SIGKILL)
        process.send_signal(signal.SIGTERM)
    else:
        os.killpg(process.pid, signal.SIGTERM)
    assert_interrupted(process, folder)


def test_a_signal_while_the_main_thread_waits_for_a_dead_part_of_ray(start: Start, tmp_path: Path) -> None:
    """In Ray's native code, where no handler in Python is called: a signal to all processes may come to this."""
    folder = tmp_path / "sweeps" / "cut"
    process = start()
    wait_until(functools.partial(has_new, folder, set()), process)
    # Whoever begins or ends meanwhile may hide others in what the system tells of a process's children.
    pids: dict[str, int] = {}

    def are_known() -> bool:
        pids.update(named(process.pid, "gcs_server", "ray::PackTrainable"))
        return len(pids) == 2

    wait_until(are_known, process)
    control, pack = pids["gcs_server"], pids["ray::PackTrainable"]
    os.kill(control, signal.SIGSTOP)
    # What the pack had is given back when its process has died, which the control process has to confirm.
    os.kill(pack, signal.SIGKILL)
    time.sleep(3)
    process.send_signal(signal.SIGTERM)
    os.kill(control, signal.SIGKILL)
    assert_interrupted(process, folder)

"""A sweep ends in order wherever it is: while Ray starts, without its terminal, and when Ray itself dies."""

from __future__ import annotations

import contextlib
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
# Trials that would take hours.
SPEC = """
env: CartPole-v1
algorithm: ppo
hyperparams: {hidden_sizes: [8]}
num_samples: 2
stop: {num_env_steps: 500_000_000}
evaluation: {every_iterations: 2, num_episodes: 2}
checkpoints: {every_iterations: 2, keep: 1}
resources: {max_concurrent: 1}
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


def wait_until(condition: Callable[[], object], process: subprocess.Popen[str], limit_s: float = 240) -> None:
    deadline = time.monotonic() + limit_s
    while not condition():
        assert process.poll() is None, "it ended too early"
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.fixture
def launch(tmp_path: Path) -> Iterator[Start]:
    """Launch the sweep `cut` in a process; whatever is left of it is ended."""
    (tmp_path / "spec.yaml").write_text(SPEC)
    processes = []

    def start(*options: str, **how: Any) -> subprocess.Popen[str]:
        how = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **how}
        process = subprocess.Popen(
            [PROGRAM, "launch", "spec.yaml", "--name", "cut", *options], cwd=tmp_path, text=True, **how
        )
        processes.append(process)
        return process

    yield start
    for process in processes:
        process.kill()
        process.wait()


def state(folder: Path) -> str:
    return str(json.loads((folder / "sweep.json").read_text())["state"])


def half_made(folder: Path) -> set[str]:
    """The hidden files of a sweep that are there only while it runs."""
    kept = {".lock", ".driver-lock", ".owner", ".p00.owner"}
    return {path.name for path in folder.rglob(".*") if path.is_file() and "tune" not in path.parts} - kept


def has_checkpoint(folder: Path) -> bool:
    return any(folder.glob("trials/*/checkpoints/0*"))


def resumes(folder: Path) -> dict[str, Any]:
    """Resume it, and stop it as soon as it has got further; how it was left then."""
    before = {path.name for path in folder.glob("trials/*/checkpoints/0*")}
    process = subprocess.Popen([PROGRAM, "resume", str(folder), "--no-finish"], stderr=subprocess.PIPE, text=True)
    try:
        wait_until(lambda: {path.name for path in folder.glob("trials/*/checkpoints/0*")} - before, process)
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=240)
    finally:
        process.kill()
    assert process.returncode == 130, err
    return {path.parent.name: json.loads(path.read_text()) for path in folder.glob("trials/*/trial.json")}


def test_a_signal_while_ray_starts(launch: Start, tmp_path: Path) -> None:
    folder = tmp_path / "sweeps" / "cut"
    process = launch()
    wait_until(lambda: child(process.pid, "gcs_server"), process)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=240)
    assert process.returncode == 130, out + err
    assert err.strip().splitlines()[-1].endswith("Continue with: tune-jobs resume cut"), err
    assert state(folder) == "interrupted"
    assert half_made(folder) == set()


def test_a_terminal_that_goes_away(launch: Start, tmp_path: Path) -> None:
    """As a dropped ssh line: the process gets SIGHUP, and whatever it prints from then on is an error."""
    folder = tmp_path / "sweeps" / "cut"
    ours, theirs = pty.openpty()
    # A session of its own, whose terminal this becomes as it is opened.
    name = os.ttyname(theirs)
    process = launch(
        stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True, preexec_fn=lambda: os.open(name, os.O_RDWR)
    )
    os.close(theirs)
    os.set_blocking(ours, False)

    def read_and_look() -> bool:
        with contextlib.suppress(BlockingIOError):
            os.read(ours, 1 << 16)
        return has_checkpoint(folder)

    wait_until(read_and_look, process)
    os.close(ours)
    assert process.wait(240) == 130
    assert state(folder) == "interrupted"
    trial = json.loads((folder / "trials/t0000/trial.json").read_text())
    assert trial["status"] == "paused"
    assert trial["checkpoints"][-1]["iteration"] == trial["num_iterations"]


@pytest.mark.parametrize(("program", "name"), [("gcs_server", "control process (GCS)"), ("raylet", "raylet")])
def test_a_part_of_ray_that_dies(launch: Start, tmp_path: Path, program: str, name: str) -> None:
    folder = tmp_path / "sweeps" / "cut"
    process = launch("--set", "max_retries=0")
    wait_until(lambda: has_checkpoint(folder), process)
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
    assert {trial["status"] for trial in resumes(folder).values()} <= {"paused", "pending"}

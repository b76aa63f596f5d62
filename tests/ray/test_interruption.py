"""A sweep that is interrupted or killed goes on where it was: the real command, real signals."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ray

PROGRAM = str(Path(sys.executable).with_name("tune-jobs"))
# One trial at once, so that one is done, one runs and one waits when the signal comes.
SPEC = """
env: CartPole-v1
algorithm: ppo
space: {lr: {loguniform: [1e-4, 1e-2]}}
num_samples: 3
stop: {num_env_steps: 60_000}
evaluation: {every_iterations: 2, num_episodes: 2}
checkpoints: {every_iterations: 2, keep: 1}
resources: {max_concurrent: 1}
"""


def read(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(path.read_text()) for path in sorted(folder.glob("trials/*/trial.json"))]


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[str], limit_s: float = 600) -> None:
    deadline = time.monotonic() + limit_s
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)


def wait_until_gone(pid: int, limit_s: float = 600) -> None:
    """Until a trial's process has ended; one that nobody waits for is a zombie."""
    deadline = time.monotonic() + limit_s
    while (stat := Path(f"/proc/{pid}/stat")).exists() and stat.read_text().rpartition(")")[2].split()[0] not in "ZX":
        assert time.monotonic() < deadline, f"process {pid} still runs"
        time.sleep(0.05)


@pytest.fixture
def interrupted(tmp_path: Path, request: pytest.FixtureRequest) -> tuple[Path, int, str]:
    """A sweep that got a signal when its first trial was done and its second had checkpoints; and how it ended."""
    (tmp_path / "spec.yaml").write_text(SPEC)
    folder = tmp_path / "sweeps" / "cut"
    process = subprocess.Popen(
        [PROGRAM, "launch", "spec.yaml", "--name", "cut", "--no-finish"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )

    def second_has_checkpoints() -> bool:
        records = read(folder)
        return len(records) == 3 and records[0]["status"] == "completed" and bool(records[1]["checkpoints"])

    try:
        wait_until(second_has_checkpoints, process)
        process.send_signal(request.param)
        out, err = process.communicate(timeout=600)
    finally:
        process.kill()
    return folder, process.returncode, out + err


def check_resumes(folder: Path) -> None:
    before = read(folder)
    first_trial = folder / "trials" / "t0000"
    untouched = {path: path.stat().st_mtime_ns for path in first_trial.rglob("*") if path.is_file()}
    latest = max(int(path.name) for path in (folder / "trials/t0001/checkpoints").glob("[0-9]*"))
    done = subprocess.run(
        [PROGRAM, "resume", str(folder), "--json", "--no-finish"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    after = read(folder)
    assert [record["status"] for record in after] == ["completed"] * 3
    assert [record["hyperparams"] for record in after] == [record["hyperparams"] for record in before]
    assert {path: path.stat().st_mtime_ns for path in untouched} == untouched
    lines = [json.loads(line) for line in (folder / "trials/t0001/results.jsonl").read_text().splitlines()]
    # Every iteration once and in order, though some were done twice or torn.
    assert [line["iteration"] for line in lines] == list(range(1, len(lines) + 1))
    assert 0 < latest < len(lines)
    steps = [line["num_env_steps"] for line in lines]
    assert steps == sorted(steps)
    assert steps[-1] >= 60_000 > steps[-2]
    # It went on from its checkpoint: had it begun anew, its log would show a second trial of as many iterations.
    seconds = [line["time_s"] for line in lines]
    assert seconds == sorted(seconds)


@pytest.mark.parametrize("interrupted", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], indirect=True)
def test_a_signal_saves_and_stops(interrupted: tuple[Path, int, str]) -> None:
    folder, code, output = interrupted
    assert code == 130, output
    assert output.strip().splitlines()[-1].endswith(f"tune-jobs resume {folder.name}"), output
    records = read(folder)
    assert [record["status"] for record in records] == ["completed", "paused", "pending"]
    # The paused trial saved the very iteration it was in.
    assert records[1]["checkpoints"][-1]["iteration"] == records[1]["num_iterations"]
    assert json.loads((folder / "sweep.json").read_text())["state"] == "interrupted"
    check_resumes(folder)


@pytest.mark.parametrize("interrupted", [signal.SIGKILL], indirect=True)
def test_a_kill_loses_no_more_than_the_last_iterations(interrupted: tuple[Path, int, str]) -> None:
    folder, code, _ = interrupted
    assert code == -signal.SIGKILL
    pid = read(folder)[1]["pid"]
    wait_until_gone(pid)
    status = subprocess.run([PROGRAM, "status", str(folder), "--json"], capture_output=True, text=True, check=True)
    assert json.loads(status.stdout)["sweep"]["state"] == "interrupted"
    with (folder / "trials/t0001/results.jsonl").open("a") as file:
        file.write('{"iteration": 99, "num_env')  # a line torn by the kill
    check_resumes(folder)

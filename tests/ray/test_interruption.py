"""A sweep that is interrupted or killed goes on where it was: the real command, real signals."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.kills.ports import listening
from tests.kills.processes import Family

pytestmark = pytest.mark.ray

PROGRAM = str(Path(sys.executable).with_name("tune-jobs"))
NUM_ENV_STEPS = 7_680
# One trial at once, so that one is done, one runs and one waits when the signal comes; slow, by waiting, while the file
# {slow} is there.
SPEC = """
env:
  id: TestTrouble-v0
  args: {{pause_s: 0.005, pause_while: "{slow}"}}
algorithm: ppo
hyperparams: {{hidden_sizes: [8], num_envs: 4, train_batch_size: 128, minibatch_size: 64, num_epochs: 2}}
space: {{lr: {{loguniform: [1e-4, 1e-2]}}}}
num_samples: 3
stop: {{num_env_steps: {num_env_steps}}}
evaluation: {{every_iterations: 2, num_episodes: 2}}
checkpoints: {{every_iterations: 2, keep: 1}}
resources: {{max_concurrent: 1}}
"""


def read(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(path.read_text()) for path in sorted(folder.glob("trials/*/trial.json"))]


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[str], limit_s: float = 600) -> None:
    deadline = time.monotonic() + limit_s
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)


def command_of(pid: int) -> str:
    """A process's command, by the name that Ray gives it if it does; empty if it has ended."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text(errors="replace").replace("\0", " ").strip()
    return ""


def wait_until_gone(pid: int, limit_s: float = 600) -> None:
    """Until a trial's process has ended; one that nobody waits for is a zombie."""
    deadline = time.monotonic() + limit_s
    while (stat := Path(f"/proc/{pid}/stat")).exists() and stat.read_text().rpartition(")")[2].split()[0] not in "ZX":
        assert time.monotonic() < deadline, f"process {pid} still runs"
        time.sleep(0.05)


class Sweep:
    """The sweep `cut` in a folder, run by the command there."""

    def __init__(self, cwd: Path) -> None:
        self.cwd, self.folder = cwd, cwd / "sweeps" / "cut"
        self.slow = cwd / "slow"
        self.listens_at: set[str] = set()
        self.programs: list[str] = []
        (cwd / "spec.yaml").write_text(SPEC.format(slow=self.slow, num_env_steps=NUM_ENV_STEPS))

    def interrupt(self, number: signal.Signals, *command: str) -> tuple[int, str]:
        """Run it until its first trial is done and its second has new checkpoints, and send a signal; how it ended."""
        newest = self.newest() if self.folder.exists() else 0
        process = subprocess.Popen(
            [PROGRAM, *command, "--no-finish"],
            cwd=self.cwd,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

        def second_has_checkpoints() -> bool:
            records = read(self.folder)
            if len(records) < 3 or records[0]["status"] != "completed":
                return False
            self.slow.touch()
            return self.newest() > newest

        try:
            wait_until(second_has_checkpoints, process)
            with Family(process.pid) as family:
                self.listens_at |= set(listening(family.alive()))
                self.programs = [command_of(pid) for pid in family.alive()]
            process.send_signal(number)
            out, err = process.communicate(timeout=600)
        finally:
            process.kill()
        return process.returncode, out + err

    def newest(self) -> int:
        """The iteration of the second trial's newest checkpoint on record."""
        return max((int(checkpoint["iteration"]) for checkpoint in read(self.folder)[1]["checkpoints"]), default=0)

    def first_trial(self) -> dict[Path, int]:
        """When each file of the trial that is done was written."""
        files = (self.folder / "trials" / "t0000").rglob("*")
        return {path: path.stat().st_mtime_ns for path in files if path.is_file()}

    def check_resumes(self) -> None:
        """It goes on to its end, fast, from where it was."""
        self.slow.unlink()
        before, untouched = read(self.folder), self.first_trial()
        latest = max(int(path.name) for path in (self.folder / "trials/t0001/checkpoints").glob("[0-9]*"))
        done = subprocess.run(
            [PROGRAM, "resume", str(self.folder), "--json", "--no-finish"], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        after = read(self.folder)
        assert [record["status"] for record in after] == ["completed"] * 3
        assert [record["hyperparams"] for record in after] == [record["hyperparams"] for record in before]
        assert self.first_trial() == untouched
        results = (self.folder / "trials/t0001/results.jsonl").read_text()
        lines = [json.loads(line) for line in results.splitlines()]
        # Every iteration once and in order, though some were done twice or torn.
        assert [line["iteration"] for line in lines] == list(range(1, len(lines) + 1))
        assert 0 < latest < len(lines)
        steps = [line["num_env_steps"] for line in lines]
        assert steps == sorted(steps)
        assert steps[-1] >= NUM_ENV_STEPS > steps[-2]
        # It went on from its checkpoint, or a later one: a killed driver's trial trains on for a moment.
        log = (self.folder / "trials/t0001/log.txt").read_text()
        assert int(re.findall(r"built from checkpoint (\d+)", log)[-1]) >= latest
        seconds = [line["time_s"] for line in lines]
        assert seconds == sorted(seconds)


@pytest.fixture
def sweep(env_plugin: None, tmp_path: Path) -> Sweep:
    return Sweep(tmp_path)


def test_signals_save_and_stop_and_the_sweep_goes_on_after_each(sweep: Sweep) -> None:
    command = ["launch", "spec.yaml", "--name", "cut"]
    untouched: dict[Path, int] = {}
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        code, output = sweep.interrupt(number, *command)
        assert code == 130, output
        assert output.strip().splitlines()[-1].endswith("tune-jobs resume cut"), output
        records = read(sweep.folder)
        assert [record["status"] for record in records] == ["completed", "paused", "pending"]
        # The paused trial saved the very iteration it was in.
        assert records[1]["checkpoints"][-1]["iteration"] == records[1]["num_iterations"]
        assert json.loads((sweep.folder / "sweep.json").read_text())["state"] == "interrupted"
        untouched = untouched or sweep.first_trial()
        assert sweep.first_trial() == untouched
        command = ["resume", "cut"]
    sweep.check_resumes()


def test_a_kill_loses_no_more_than_the_last_iterations(sweep: Sweep) -> None:
    code, _ = sweep.interrupt(signal.SIGKILL, "launch", "spec.yaml", "--name", "cut")
    assert code == -signal.SIGKILL
    # Nobody on another machine reaches a sweep's processes, those of Ray among them.
    assert len(sweep.listens_at) >= 5
    assert {address.rpartition(":")[0] for address in sweep.listens_at} == {"127.0.0.1"}
    # Ray starts no agent for the dashboard that is not there.
    assert [program for program in sweep.programs if "idle_agent.py" in program]
    assert not [program for program in sweep.programs if "DashboardAgent" in program or "agent.py" in program.split()]
    wait_until_gone(read(sweep.folder)[1]["pid"])
    command = [PROGRAM, "status", str(sweep.folder), "--json"]
    status = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(status.stdout)["sweep"]["state"] == "interrupted"
    with (sweep.folder / "trials/t0001/results.jsonl").open("a") as file:
        file.write('{"iteration": 99, "num_env')  # a line torn by the kill
    sweep.check_resumes()

"""A real service with a real sweep: submitted, stopped, resumed and extended over HTTP, drained and begun again."""

import json
import os
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tune_jobs.store.sweep_store import SweepStore

pytestmark = pytest.mark.ray
PATIENCE_S = 240.0
SPEC = {
    "env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"loguniform": [1e-3, 1e-2]}}, "num_samples": 2,
    "hyperparams": {"train_batch_size": 256, "num_envs": 2}, "confirm": "none",
    "evaluation": {"every_iterations": 50, "num_episodes": 2}, "checkpoints": {"every_iterations": 20},
    # Each has about a minute to be stopped in.
    "stop": {"num_env_steps": 200_000, "evaluation_return": 1_000},
}  # fmt: skip


class Server:
    """`tune-jobs serve` in a process of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.log = folder.with_name("serve.log")
        with self.log.open("ab") as log:
            begin = self.log.stat().st_size
            self.process = subprocess.Popen(
                [sys.executable, "-c", "from tune_jobs.cli.commands import main; main()", "serve", "--port", "0",
                 "--storage", str(folder), "--spare-idle", "0"],
                stdout=log, stderr=log, env=os.environ | {"PYTHONUNBUFFERED": "1"},
            )  # fmt: skip
        self.url = ""
        self.wait(lambda: " at http://" in self.said(begin), "it never began")
        self.url = "http://" + self.said(begin).split(" at http://")[1].split()[0]

    def said(self, begin: int = 0) -> str:
        return self.log.read_bytes()[begin:].decode()

    def ask(self, method: str, path: str, body: Any = None) -> Any:
        request = urllib.request.Request(
            f"{self.url}/api/v1/{path}", method=method, headers={"Content-Type": "application/json"},
            data=None if body is None else json.dumps(body).encode(),
        )  # fmt: skip
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.loads(answer.read() or b"null")

    def wait(self, condition: Callable[[], object], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert self.process.poll() is None, self.said()
            assert time.monotonic() < deadline, f"{what}: {self.said()}"
            time.sleep(0.05)

    def wait_for_job(self, state: str = "ended") -> dict[str, Any]:
        self.wait(lambda: self.ask("GET", "jobs")[-1]["state"] == state, f"the last job is not {state}")
        found: dict[str, Any] = self.ask("GET", "jobs")[-1]
        return found

    def steps(self, name: str) -> int:
        return int(self.ask("GET", f"sweeps/{name}")["num_env_steps"])

    def end(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(PATIENCE_S)


@pytest.fixture
def storage(tmp_path: Path) -> Path:
    return tmp_path / "sweeps"


def test_a_sweep_from_its_submission_to_its_report(storage: Path) -> None:
    server = Server(storage)
    try:
        server.ask("POST", "sweeps", {"spec": SPEC, "name": "mine"})
        server.wait(lambda: server.steps("mine") > 0, "nothing was trained")
        server.ask("POST", "sweeps/mine/stop")
        assert server.wait_for_job()["outcome"] == "stopped"
        stopped = server.ask("GET", "sweeps/mine")
        assert stopped["state"] == "interrupted"
        before = stopped["num_env_steps"]
        assert 0 < before < 400_000
        # It goes on where it was; and when the service ends, too.
        server.ask("POST", "sweeps/mine/resume")
        server.wait(lambda: server.steps("mine") > before, "it does not go on")
        assert server.end() == 0
        saved = SweepStore(storage / "mine").read_record()
        assert saved.state == "interrupted"
        reached = sum(trial.num_env_steps for trial in SweepStore(storage / "mine").read_trials())
        server = Server(storage)
        server.wait(lambda: server.steps("mine") > reached, "it is forgotten")
        # The time is short here: the rest is done with less.
        assert server.ask("GET", "jobs")[-1]["state"] == "running"
        server.ask("POST", "sweeps/mine/stop")
        assert server.wait_for_job()["outcome"] == "stopped"
        short = SPEC | {"stop": {"num_env_steps": 2_560}}
        server.ask("POST", "sweeps", {"spec": short, "name": "short"})
        server.ask("POST", "sweeps/short/extend", {"num_samples": 1})
        assert server.wait_for_job()["outcome"] == "completed"
        found = server.ask("GET", "sweeps/short")
        assert (found["state"], found["num_trials"], found["counts"]) == ("completed", 3, {"completed": 3})
        assert (storage / "short" / "report" / "index.html").exists()
        with pytest.raises(urllib.error.HTTPError, match="409"):
            server.ask("POST", "sweeps/short/stop")
        assert server.end() == 0
    finally:
        if server.process.poll() is None:
            server.end()

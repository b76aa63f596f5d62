"""`tune-jobs serve` in a process of its own, asked over HTTP."""

import json
import os
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

PATIENCE_S = 240.0
_COMMAND = (sys.executable, "-c", "from tune_jobs.cli.commands import main; main()", "serve")


class Served:
    """A service that was started, and answers.

    Args:
        folder: Its storage.
        options: More options of the command.
        command: What is run instead of the command.
        variables: More variables of its environment.
    """

    def __init__(
        self,
        folder: Path,
        *options: str,
        command: Sequence[str] = _COMMAND,
        variables: Mapping[str, str] | None = None,
    ) -> None:
        self.folder = folder
        self.log = folder.with_name("serve.log")
        with self.log.open("ab") as log:
            begin = self.log.stat().st_size
            self.process = subprocess.Popen(
                [*command, "--port", "0", "--storage", str(folder), *options],
                stdout=log, stderr=log, env=os.environ | {"PYTHONUNBUFFERED": "1"} | dict(variables or {}),
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
            time.sleep(0.02)

    def wait_for_job(self, state: str = "ended") -> dict[str, Any]:
        self.wait(lambda: self.ask("GET", "jobs")[-1]["state"] == state, f"the last job is not {state}")
        found: dict[str, Any] = self.ask("GET", "jobs")[-1]
        return found

    def steps(self, name: str) -> int:
        return int(self.ask("GET", f"sweeps/{name}")["num_env_steps"])

    def end(self) -> int:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        return self.process.wait(PATIENCE_S)

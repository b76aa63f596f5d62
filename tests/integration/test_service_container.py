"""The service as the first process of a container: namespaces of its own, a read-only root, a volume that stays.

Each container has other process ids and another host's name; its sweeps are real processes that only wait.
"""

import contextlib
import functools
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from synthetic_sweep import make_sweep_record

from tune_jobs.service.job_files import SERVICE_FOLDER
from tune_jobs.store.sweep_store import SweepStore

HERE = Path(__file__).parents[1] / "unit"
UNSHARE = ["unshare", "--mount", "--pid", "--uts", "--net", "--fork", "--kill-child", "--mount-proc"]
if os.geteuid() != 0:
    UNSHARE += ["--user", "--map-root-user"]
PATIENCE_S = 30.0


@functools.cache
def why_not() -> str | None:
    """Why this machine has no containers for us; None: it has."""
    try:
        done = subprocess.run([*UNSHARE, "mount", "--bind", "/", "/mnt"], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return "there is no unshare"
    return f"unshare is not permitted: {done.stderr.strip()}" if done.returncode else None


class Container:
    """A service in a container, begun with a volume.

    Args:
        volume: The folder that stays; it is the only one that may be written.
        name: The host's name.
    """

    def __init__(self, volume: Path, name: str) -> None:
        self.volume = volume
        volume.mkdir(exist_ok=True)
        serve = [sys.executable, str(HERE / "container_service.py"), "serve", "--storage", "/mnt", "--port", "8470",
                 "--spare-idle", "0"]  # fmt: skip
        script = f"""
            mount --make-rprivate /
            mount --bind {shlex.quote(str(volume))} /mnt
            mount -o remount,bind,ro /
            hostname {name}
            ip link set lo up 2> /dev/null || true
            exec {shlex.join(serve)}
        """
        self.log = volume.with_name(f"{name}.log")
        # No HOME, and nothing else that a login sets.
        environment = {
            "PATH": os.environ["PATH"], "PYTHONPATH": f"{HERE}:{HERE.parents[1]}", "PYTHONDONTWRITEBYTECODE": "1",
        }  # fmt: skip
        with self.log.open("wb") as log:
            self.outside = subprocess.Popen(
                [*UNSHARE, "sh", "-ec", script], stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment,
                start_new_session=True,
            )  # fmt: skip
        self.wait(lambda: b" at http://" in self.log.read_bytes(), "it never began")
        self.first = int(Path(f"/proc/{self.outside.pid}/task/{self.outside.pid}/children").read_text())

    def wait(self, condition: Callable[[], object], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert self.outside.poll() is None, self.log.read_text()
            assert time.monotonic() < deadline, f"{what}: {self.log.read_text()}"
            time.sleep(0.02)

    def zombies(self) -> str:
        """What has ended and was not asked how, as the container's own /proc says."""
        said = self.enter("cat /proc/[0-9]*/stat 2> /dev/null || true").stdout
        return "\n".join(line for line in said.splitlines() if line.rpartition(")")[2].split()[0] == "Z")

    def enter(self, script: str) -> subprocess.CompletedProcess[str]:
        """Run a shell's script in it."""
        enter = ["nsenter", f"--target={self.first}", "--mount", "--pid", "--net"]
        if os.geteuid() != 0:
            enter += ["--user", "--preserve-credentials"]
        return subprocess.run([*enter, "sh", "-ec", script], capture_output=True, text=True, check=True, timeout=60)

    def ask(self, path: str) -> Any:
        code = f"import urllib.request as r; print(r.urlopen('http://127.0.0.1:8470{path}').read().decode())"
        return json.loads(self.enter(shlex.join([sys.executable, "-S", "-c", code])).stdout)

    def kill(self) -> None:
        """End it as `docker kill` does."""
        os.kill(self.first, signal.SIGKILL)
        self.outside.wait(PATIENCE_S)

    def end(self) -> int:
        """End it as `docker stop` does, and return its exit code."""
        if self.outside.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.first, signal.SIGTERM)
        return self.outside.wait(PATIENCE_S)


@pytest.mark.skipif(why_not() is not None, reason=why_not() or "")
def test_a_sweep_goes_on_in_the_next_container_and_nothing_is_left_behind_in_one(tmp_path: Path) -> None:
    volume = tmp_path / "sweeps"
    store = SweepStore(volume / "a")
    store.create()
    record = make_sweep_record("a", "ppo", "CartPole-v1", [], 1)
    spec = record.spec | {"hyperparams": {"seconds": 100.0}}
    store.write_record(record.model_copy(update={"state": "created", "spec": spec}))
    journal = volume / SERVICE_FOLDER / "journal.jsonl"

    def begun() -> list[int]:
        return [json.loads(line)["pid"] for line in journal.read_text().splitlines()] if journal.exists() else []

    containers = []
    try:
        containers.append(first := Container(volume, "first"))
        assert first.ask("/readyz") == {"status": "ready", "problems": []}
        first.wait(begun, "the sweep was not begun")
        # Each is left to the first process, as parts of Ray are whose driver was killed.
        first.enter("for number in 1 2 3; do (sleep 0.1 &); done")
        first.enter("sleep 0.3")
        first.wait(lambda: not first.zombies(), "nobody asks how processes ended")
        first.kill()
        # The file still names the first container's process; here it is another one, or none.
        containers.append(second := Container(volume, "second"))
        second.wait(lambda: len(begun()) == 2, "the sweep was forgotten")
        assert [job["num_attempts"] for job in second.ask("/api/v1/jobs")] == [2]
        assert store.read_record().state == "running"
        assert second.end() == 0, second.log.read_text()
        containers.append(third := Container(volume, "third"))
        third.wait(lambda: len(begun()) == 3, "the sweep was not taken up")
        assert third.end() == 0
    finally:
        for container in containers:
            container.end()

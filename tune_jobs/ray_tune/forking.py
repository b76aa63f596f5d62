"""Let a local Ray's processes be forks of one that has imported what they need; see `fork_server`."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import ray

from tune_jobs.ray_tune.forks import ForkServer
from tune_jobs.ray_tune.replaced import replaced

_COMMAND = "--python_worker_command="


@contextlib.contextmanager
def forked_workers(server: ForkServer | None) -> Iterator[None]:
    """Let a Ray that is started in the block have its processes from a `fork_server`; None: from nobody."""
    if server is None:
        yield
        return
    services: Any = ray._private.services  # noqa: SLF001
    original = services.start_ray_process
    prefix = [sys.executable, "-I", "-S", str(Path(__file__).with_name("forked_worker.py")), server.address]

    def asking(part: str) -> str:
        if not part.startswith(_COMMAND):
            return part
        return f"{_COMMAND}{subprocess.list2cmdline(prefix)} {part.removeprefix(_COMMAND)}"

    def start(command: list[str], *args: Any, **kwargs: Any) -> Any:
        started = original([asking(part) for part in command], *args, **kwargs)
        if any(part.startswith(_COMMAND) for part in command):
            server.announce(_environment_of_workers(started.process.pid))
        return started

    with replaced(services, "start_ray_process", start):
        yield


def _environment_of_workers(raylet: int) -> dict[str, str]:
    """Return the environment that a raylet gives to its processes, without their jobs: its own, and who it is."""
    own = Path(f"/proc/{raylet}/environ").read_text(encoding="utf-8", errors="surrogateescape").split("\0")
    return {**dict(line.split("=", 1) for line in own if "=" in line), "RAY_RAYLET_PID": str(raylet)}

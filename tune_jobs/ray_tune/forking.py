"""Let a local Ray's processes be forks of one that has imported what they need; see `fork_server`."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import ray

from tune_jobs.ray_tune.replaced import replaced

_COMMAND = "--python_worker_command="
_PATIENCE_S = 5.0
_EARLY = (
    "torch", "tune_jobs.training.packed", "policies.packed.make", "policies.packed.envs.make",
    "policies.packed.evaluation", "policies.packed.ppo.stack", "policies.packed.dqn.stack",
    "gymnasium.envs.classic_control",
)  # fmt: skip
_LATE = ("tune_jobs.ray_tune.pack_trainable",)


@contextlib.contextmanager
def fork_server() -> Iterator[str | None]:
    """Start the process from which packs are forked, for the block.

    It is yielded where it can be asked; None: there is none, and Ray starts its processes as it does without.
    """
    if sys.platform != "linux":
        # Elsewhere the system's own libraries do not survive a fork.
        yield None
        return
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="tune-jobs-fork-", ignore_cleanup_errors=True))
        address = str(Path(folder, "asked"))
        listener = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
        program = str(Path(__file__).with_name("fork_server.py"))
        try:
            listener.bind(address)
            listener.listen(64)
            process = subprocess.Popen(  # noqa: S603 (this very Python)
                [sys.executable, program, str(listener.fileno()), ",".join(_EARLY), ",".join(_LATE)],
                # Ray says this to a process of one CPU before that imports anything; libraries read it only then, and
                # products of two threads in each pack would take the cores from one another.
                env={"OMP_NUM_THREADS": "1", **os.environ},
                stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                pass_fds=[listener.fileno()], start_new_session=True,
            )  # fmt: skip
        except OSError:
            # A path of a temporary folder may be too long for a socket: Ray's own processes do as well.
            yield None
            return
        listener.close()
        assert process.stdin is not None
        try:
            yield address
        finally:
            process.stdin.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_PATIENCE_S)


@contextlib.contextmanager
def forked_workers(address: str | None) -> Iterator[None]:
    """Let a Ray that is started in the block have its processes from a `fork_server`; None: from nobody."""
    if address is None:
        yield
        return
    services: Any = ray._private.services  # noqa: SLF001
    original = services.start_ray_process
    prefix = [sys.executable, "-I", "-S", str(Path(__file__).with_name("forked_worker.py")), address]

    def asking(part: str) -> str:
        if not part.startswith(_COMMAND):
            return part
        return f"{_COMMAND}{subprocess.list2cmdline(prefix)} {part.removeprefix(_COMMAND)}"

    def start(command: list[str], *args: Any, **kwargs: Any) -> Any:
        return original([asking(part) for part in command], *args, **kwargs)

    with replaced(services, "start_ray_process", start):
        yield

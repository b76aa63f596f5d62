"""Start the process from which a local Ray's processes are forked (`fork_server`), also before there is a Ray.

It loads no ray, so that the process can begin to import while this one has yet to.
"""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from os import environ
from pathlib import Path
from typing import Literal, TypeAlias

Forked: TypeAlias = Literal["packs", "trials"]
"""What is forked: processes that train packs, or single trials of RLlib with their env runners."""

_PATIENCE_S = 5.0
_EARLY: dict[Forked, tuple[str, ...]] = {
    "packs": (
        "torch", "tune_jobs.training.packed", "policies.packed.make", "policies.packed.envs.make",
        "policies.packed.evaluation", "policies.packed.ppo.stack", "policies.packed.dqn.stack",
        "gymnasium.envs.classic_control",
    ),
    "trials": ("torch", "policies.acting.evaluate", "gymnasium.envs.classic_control", "pandas"),
}  # fmt: skip
_LATE: dict[Forked, tuple[str, ...]] = {
    "packs": ("tune_jobs.ray_tune.pack_trainable",),
    "trials": ("tune_jobs.ray_tune.trainable", "tune_jobs.training.rllib"),
}


class ForkServer:
    """The process from which a Ray's processes are forked.

    Args:
        folder: Where it is asked; it is removed at the end.
        listener: Where it is asked.
        forked: What is forked from it, for which it imports what they need.

    Raises:
        OSError: It cannot be started.
    """

    def __init__(self, folder: tempfile.TemporaryDirectory[str], listener: socket.socket, forked: Forked) -> None:
        self._folder = folder
        self.address = str(Path(folder.name, "asked"))
        """Where it is asked."""
        program = str(Path(__file__).with_name("fork_server.py"))
        listener.bind(self.address)
        listener.listen(64)
        self._process = subprocess.Popen(  # noqa: S603 (this very Python)
            [sys.executable, program, str(listener.fileno()), ",".join(_EARLY[forked]), ",".join(_LATE[forked])],
            # Ray says this to a process of one CPU before that imports anything; libraries read it only then, and
            # products of two threads in each pack would take the cores from one another.
            env={"OMP_NUM_THREADS": "1", **environ},
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            pass_fds=[listener.fileno()], start_new_session=True,
        )  # fmt: skip

    def announce(self, environment: Mapping[str, str]) -> None:
        """Tell it the environment of the processes that it will be asked for, so that it imports Ray before it is.

        Where it is another one in the end, Ray starts the processes itself.
        """
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.settimeout(_PATIENCE_S)
            connection.connect(self.address)
            connection.sendall(json.dumps({"environment": dict(environment)}).encode() + b"\n")

    def close(self, *, at_once: bool = False) -> None:
        """End it, and what was forked from it; it may be closed again.

        Args:
            at_once: Whether nothing was forked from it, so that it need not come to its end.
        """
        assert self._process.stdin is not None
        if at_once:
            self._process.kill()
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            # On a busy machine it may still import, and what it has forked ends with it either way.
            self._process.kill()
            self._process.wait()
        self._folder.cleanup()


_ahead: list[ForkServer] = []
"""The one that was begun and is not taken yet."""


@contextlib.contextmanager
def begun_ahead(forked: Forked | None) -> Iterator[None]:
    """Begin a fork server, which the first `fork_server` of the block takes: it imports while a sweep is planned.

    Args:
        forked: What is forked from it, as far as is known; None: none is begun. There is one for a process at most.
    """
    server = None if forked is None or _ahead else _begin(forked)
    if server is None:
        yield
        return
    _ahead.append(server)
    try:
        yield
    finally:
        if server in _ahead:
            _ahead.remove(server)
            server.close(at_once=True)


@contextlib.contextmanager
def fork_server(forked: Forked) -> Iterator[ForkServer | None]:
    """Start the process from which a Ray's are forked, for the block, or take the one that was begun ahead.

    None: there is none, and Ray starts its processes as it does without.

    Args:
        forked: What is forked from it. One that was begun for the other kind does, too: the rest is imported anew.
    """
    server = _ahead.pop() if _ahead else _begin(forked)
    try:
        yield server
    finally:
        if server is not None:
            server.close()


def _begin(forked: Forked) -> ForkServer | None:
    if sys.platform != "linux":
        # Elsewhere the system's own libraries do not survive a fork.
        return None
    folder = tempfile.TemporaryDirectory(prefix="tune-jobs-fork-", ignore_cleanup_errors=True)
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
            return ForkServer(folder, listener, forked)
    except OSError:
        # A path of a temporary folder may be too long for a socket: Ray's own processes do as well.
        folder.cleanup()
        return None

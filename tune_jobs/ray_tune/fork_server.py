"""A process that has imported what trials need, from which the processes of a local Ray are forked (decision 37).

Ray 2.60 starts a process for each actor, and one that trains would import modules for three seconds before its first
env step. A fork takes some hundredths of a second, and shares the memory of those modules.

It is run by its path. It has one thread of Python, joins no Ray and asks no GPU: neither would survive a fork.
`forked_worker` asks it, in the place of Ray's own command.
"""

from __future__ import annotations

import sys

if __name__ == "__main__" and not sys.flags.safe_path:
    # The folder of this file, in which names of others would be found.
    del sys.path[0]

import array
import contextlib
import ctypes
import gc
import importlib
import json
import os
import resource
import runpy
import select
import signal
import socket
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

_PR_SET_PDEATHSIG = 1
_NUM_STREAMS = 3
_PATIENCE_S = 10.0
_CHUNK = 1 << 16
_JOB, _ANY_JOB = "RAY_JOB_ID", "ffffffff"


def main(listener: socket.socket, early: list[str], late: list[str]) -> Callable[[], None] | None:
    """Import modules, and fork a process for each that asks, until standard input is closed.

    Args:
        listener: Where is asked.
        early: What is imported at once, none of which may import Ray. A module that can't be imported is left to the
            processes that need it.
        late: What is imported when the first process asks, or when it is announced.

    Returns:
        In a forked process, what it does; None: there is nothing left to do in this one.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # The driver ends this process. The forked ones do with signals what those do that Ray starts.
        signal.signal(number, signal.SIG_IGN)
    # What is imported stays. Looking through it for garbage takes a sixth of the time of importing it, and would have
    # each forked process write to memory that it shares with this one.
    gc.disable()
    _import("tune_jobs", *early)
    kernel = ctypes.CDLL(None)
    # What has ended needs nobody who asks how.
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    known: dict[str, str] | None = None
    while True:
        ready, _, _ = select.select([listener.fileno(), 0], [], [])
        if 0 in ready:
            return None
        connection, _ = listener.accept()
        with connection, contextlib.suppress(OSError, ValueError):
            connection.settimeout(_PATIENCE_S)
            asked, streams = _receive(connection)
            if known is None:
                known = _settings_of_ray(asked)
                _import_ray(known, late)
                if not _draws_differ():
                    # A Ray of another version: it starts its processes itself.
                    return None
                gc.freeze()
            pid = -1
            # Nothing is forked for what is announced. Those who ask with other settings, or wait no more, become Ray's
            # own command.
            if "command" in asked and _settings_of_ray(asked) == known and _is_waiting(connection):
                pid = _fork(kernel, connection)
            if pid == 0:
                listener.close()
                connection.close()
                return lambda: _work(asked, streams)
            for stream in streams:
                os.close(stream)
            if pid > 0:
                connection.sendall(str(pid).encode())


def _is_waiting(connection: socket.socket) -> bool:
    return not select.select([connection], [], [], 0)[0]


def _is_taken(connection: socket.socket) -> bool:
    """Wait until who asked says that the forked process is the one, or that it is not, by its end."""
    connection.settimeout(None)
    with contextlib.suppress(OSError):
        return bool(connection.recv(1))
    return False


def _fork(kernel: ctypes.CDLL, connection: socket.socket) -> int:
    """Fork this process; return 0 in the forked one, which ends with this one, else its id.

    The forked one returns when who asked has taken it; it ends where that is gone.
    """
    server = os.getpid()
    pid = os.fork()
    if pid == 0:
        # Ray 2.60 ends what is left of a process's group with it.
        os.setpgid(0, 0)
        kernel.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != server or not _is_taken(connection):
            os._exit(1)
    return pid


def _import(*modules: str) -> None:
    root = str(Path(__file__).parents[2])
    # Where packages are installed, it stands behind Python's own modules, whose names some packages bear.
    is_found = root in sys.path
    if not is_found:
        sys.path.insert(0, root)
    for name in modules:
        with contextlib.suppress(Exception):
            importlib.import_module(name)
    if not is_found:
        sys.path.remove(root)


def _settings_of_ray(asked: Mapping[str, Any]) -> dict[str, str]:
    """Return the variables that Ray's native code reads once, when it is loaded.

    The job is one of them, but not the same one for all processes; see `_import_ray`.
    """
    return {key: value for key, value in asked["environment"].items() if key.startswith("RAY_") and key != _JOB}


def _import_ray(settings: Mapping[str, str], modules: list[str]) -> None:
    """Import Ray as for a process of any job, as those are that Ray starts before there is a job."""
    os.environ.update(settings)
    os.environ[_JOB] = _ANY_JOB
    _import("ray._private.workers.default_worker")
    ray: Any = sys.modules["ray"]
    of_classes = ray.actor.ActorClassID
    # A module that defines an actor draws its id when it is imported. The generator of Ray's native code would be
    # seeded by that, and all forked processes would draw the same ids, of objects too.
    ray.actor.ActorClassID = _Drawing(of_classes)
    try:
        _import(*modules)
    finally:
        ray.actor.ActorClassID = of_classes


class _Drawing:
    """Draws ids of a class from the system, and not from the generator of Ray's native code."""

    def __init__(self, ids: Any) -> None:
        self._ids = ids

    def from_random(self) -> Any:
        """Return an id that no other process draws."""
        return self._ids(os.urandom(self._ids.size()))


def _draws_differ() -> bool:
    """Whether two forked processes draw different ids, by the generator of Ray's native code."""
    draws = set()
    for _ in range(2):
        reading, writing = os.pipe()
        if os.fork() == 0:
            with contextlib.suppress(BaseException):
                os.write(writing, sys.modules["ray"].ObjectID.from_random().binary())
            os._exit(0)
        os.close(writing)
        with os.fdopen(reading, "rb") as file:
            draws.add(file.read())
    return len(draws) == 2 and b"" not in draws


def _receive(connection: socket.socket) -> tuple[dict[str, Any], list[int]]:
    """Read what a process is to be, and its standard streams."""
    streams = array.array("i")
    data, ancillary, _, _ = connection.recvmsg(_CHUNK, socket.CMSG_SPACE(_NUM_STREAMS * streams.itemsize))
    for level, kind, content in ancillary:
        if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
            streams.frombytes(content[: len(content) - len(content) % streams.itemsize])
    while not data.endswith(b"\n"):
        more = connection.recv(_CHUNK)
        if not more:
            raise ValueError("It ended before it had asked.")
        data += more
    return json.loads(data), list(streams)


def _work(asked: Mapping[str, Any], streams: list[int]) -> None:
    """Be the process that was asked for."""
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    gc.enable()
    _take_over_signals(asked)
    if asked["folder"] is not None:
        os.chdir(asked["folder"])
    os.environ.clear()
    os.environ.update(asked["environment"])
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(asked["oom_score_adj"], encoding="ascii")
    with contextlib.suppress(KeyError, OSError, ValueError):
        # Ray raises its processes' limit of open files after this process has begun.
        resource.setrlimit(resource.RLIMIT_NOFILE, tuple(asked["files"]))
    program, *options = asked["command"]
    sys.argv[:] = [program, *options]
    # As Python does when it starts; the folders of the user's modules come to PYTHONPATH after this process began.
    sys.path[:0] = [part for part in given if part and part not in sys.path]
    if not sys.flags.safe_path:
        sys.path.insert(0, os.path.dirname(program))  # noqa: PTH120
    numpy = sys.modules.get("numpy")
    if numpy is not None:
        # As Python's own generator is, so that processes do not draw the same.
        numpy.random.seed()
    runpy.run_path(program, run_name="__main__")


def _take_over_signals(asked: Mapping[str, Any]) -> None:
    """Do with signals what the process that asked would do."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGCHLD):
        signal.signal(number, signal.SIG_IGN if number in asked["ignored"] else signal.SIG_DFL)
    if signal.SIGINT not in asked["ignored"]:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.pthread_sigmask(signal.SIG_SETMASK, asked["blocked"])


if __name__ == "__main__":
    _, _descriptor, _early, _late = sys.argv
    _listener = socket.socket(fileno=int(_descriptor))
    _asked = Path(_listener.getsockname())
    _job = main(_listener, _early.split(","), _late.split(","))
    if _job is None:
        # Who started it may have been killed.
        with contextlib.suppress(OSError):
            _asked.unlink()
            _asked.parent.rmdir()
        # Nothing is to be saved, and to take down what was imported takes most of a second.
        os._exit(0)
    _job()

"""Start driver processes, and keep one that has everything imported before there is a job for it."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from policies.errors import CannotRunError

_PATIENCE_S = 5.0
_ROOT = str(Path(__file__).parents[2])
# With `-P`, nothing in the working directory can hide these packages.
_BEGIN = """\
import sys
sys.path.insert(0, {root!r})
import tune_jobs
del sys.path[0]
from {module} import main
main({descriptor})
"""


class Driver:
    """A driver process that has no job yet.

    Args:
        settings: What it needs to know before there is a job, see `driver.warm_up`.
        module: The module whose `main` it calls with the descriptor of its end of the socket.

    Raises:
        CannotRunError: No process can be started.
    """

    def __init__(self, settings: Mapping[str, Any], module: str = "tune_jobs.service.driver") -> None:
        try:
            # Not SOCK_SEQPACKET, which would keep messages apart: macOS has none.
            self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        except OSError as error:
            raise _not_started(error) from error
        code = _BEGIN.format(root=_ROOT, module=module, descriptor=theirs.fileno())
        try:
            self._process = subprocess.Popen(  # noqa: S603 (this very Python)
                [sys.executable, "-P", "-c", code],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                # It lives on when the service is killed, and a terminal's Ctrl-C is the service's alone.
                start_new_session=True,
            )
        except OSError as error:
            self._socket.close()
            raise _not_started(error) from error
        finally:
            theirs.close()
        self._socket.sendall(_line(settings))

    @property
    def pid(self) -> int:
        """The process's id."""
        return self._process.pid

    def is_usable(self) -> bool:
        """Whether it lives."""
        return self._process.poll() is None

    def is_warm(self) -> bool:
        """Whether it has imported everything."""
        try:
            return bool(select.select([self._socket], [], [], 0)[0])
        except (OSError, ValueError):  # another thread has just dismissed it
            return False

    def give(self, request: Mapping[str, Any], lock: int, log: Path) -> None:
        """Give it a job; from now on it needs nobody.

        Args:
            request: The job, see `driver`.
            lock: A descriptor that holds the job's lock; the caller's copy is the caller's to close.
            log: The file for what it prints.

        Raises:
            CannotRunError: It died before, or the file can't be written.
        """
        try:
            log.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o600)
        except OSError as error:
            raise CannotRunError(
                f"The service can't write {log}: {error.strerror}.", "Check the storage folder."
            ) from error
        line = _line(request)
        try:
            num_sent = socket.send_fds(self._socket, [line], [lock, descriptor])
            self._socket.sendall(line[num_sent:])
        except OSError as error:
            raise CannotRunError(f"The process {self.pid} for the sweep died before it began: {error}.") from error
        finally:
            os.close(descriptor)

    def poll(self) -> int | None:
        """Return its exit code, which also frees what the system keeps of it; None: it runs."""
        code = self._process.poll()
        if code is not None:
            # Not before: what it has said and nobody has read would make its end of a closed socket an error.
            self._socket.close()
        return code

    def dismiss(self) -> None:
        """End it, as no job comes."""
        self._socket.close()
        # It ends by itself when it sees that; while it starts Ray it does not look.
        for number in (None, signal.SIGTERM, signal.SIGKILL):
            if number is not None:
                self._process.send_signal(number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_PATIENCE_S)
                return


def _not_started(error: OSError) -> CannotRunError:
    return CannotRunError(
        f"No process can be started to run a sweep in ({sys.executable}): {error}.",
        "See what limits the processes and the files of this user, with `ulimit -u` and `ulimit -n`.",
    )


def _line(message: Mapping[str, Any]) -> bytes:
    """A message as `driver.main` reads it: one line, as JSON has no other end of a line in it."""
    return json.dumps(dict(message)).encode() + b"\n"


def memory_of_tree(pid: int) -> int | None:
    """Return the bytes of memory of a process and its descendants, shared pages counted by share; None: not known.

    Source:
        Pss in /proc/PID/smaps_rollup, proc(5).
    """
    parents, found = {}, 0
    try:
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                with contextlib.suppress(OSError, ValueError, IndexError):
                    parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
        tree = {pid}
        while more := {child for child, parent in parents.items() if parent in tree} - tree:
            tree |= more
        for member in tree:
            with contextlib.suppress(OSError, ValueError, IndexError):
                lines = Path(f"/proc/{member}/smaps_rollup").read_text().splitlines()
                found += 1024 * next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    except OSError:
        return None
    return found or None

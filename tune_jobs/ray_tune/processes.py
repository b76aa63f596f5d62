"""The processes of the Ray that a sweep runs on: none is left if it does not start, and a dead one is noticed."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import ray
from ray.exceptions import RayTaskError

from policies.errors import CannotRunError
from tune_jobs.process.interruption import current

_CONNECT_TIMEOUT_S = 5.0
# A control process that a cluster's operator starts again may take a little. Ray 2.60 ends a process that has not
# reached it for a minute, whatever that process still wants to save.
_OWN_GRACE_S, _CLUSTER_GRACE_S = 4.0, 15.0

# Who is told so leaves the block at once, unless it waits in a native call that only Ray could end.
_STUCK_S = 20.0

_CONTROL, _RAYLET = "control process (GCS)", "process on this node (raylet)"


@contextlib.contextmanager
def ending_if_it_fails() -> Iterator[None]:
    """If the block fails, end the processes of Ray that it started: a Ray that is not up yet does not do it."""
    before = _children_of_ray()
    try:
        yield
    except BaseException:
        with current().shielded():
            ray.shutdown()
            for pid in _children_of_ray() - before:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        raise


def _children_of_ray() -> set[int]:
    """The ids of this process's children that run a program of Ray's."""
    programs = str(Path(ray.__file__).parent)
    found = set()
    for listing in Path("/proc/self/task").glob("*/children"):
        with contextlib.suppress(OSError):
            for pid in listing.read_text(encoding="ascii").split():
                with contextlib.suppress(OSError):
                    if programs in Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8", errors="replace"):
                        found.add(int(pid))
    return found


class RayDiedError(BaseException):
    """A part of Ray is gone; no Exception, or Ray Tune would tidy up first, and wait for Ray in that."""


def ray_died(sweep: str, death: RayDiedError) -> CannotRunError:
    """What is told of it.

    Args:
        sweep: The sweep's name.
        death: What died.
    """
    return CannotRunError(
        f"Ray's {death} died, or does not answer any more: no trial can be run on it.",
        f"Did the machine run out of memory? What is done is kept; go on with `tune-jobs resume {shlex.quote(sweep)}`.",
    )


class RayWatch:
    """Notices in the background that a part of Ray does not answer any more; a context manager.

    Args:
        probes: Whether a part answers, by its name.
        grace_s: After so many seconds without an answer it is dead.
        clock: Seconds, monotonic.
        stuck_s: After so many more the block is stuck.
    """

    def __init__(
        self,
        probes: Mapping[str, Callable[[], bool]],
        grace_s: float,
        clock: Callable[[], float] = time.monotonic,
        stuck_s: float = _STUCK_S,
    ) -> None:
        self._probes, self._grace_s, self._clock, self._stuck_s = dict(probes), grace_s, clock, stuck_s
        self._silent_since: dict[str, float] = {}
        self._dead: str | None = None
        self._over = threading.Event()
        self.when_stuck: Callable[[RayDiedError], None] | None = None
        """Called in the background if the block goes on though a part is dead: Ray would end the process soon."""
        self._thread = threading.Thread(target=self._run, name="tune-jobs-ray-watch", daemon=True)

    @classmethod
    def of_this_process(cls) -> RayWatch:
        """A watch over the Ray that this process is connected to."""
        host, _, port = ray.get_runtime_context().gcs_address.rpartition(":")
        control = (host.strip("[]"), int(port))
        probes = {_CONTROL: lambda: _answers(socket.AF_INET6 if ":" in host else socket.AF_INET, control)}
        node = ray._private.worker._global_node  # noqa: SLF001 (told nowhere else)
        started = [info.process for info in node.all_processes.get("raylet", ())]
        if started:
            probes[_RAYLET] = lambda: all(process.poll() is None for process in started)
            return cls(probes, _OWN_GRACE_S)
        raylet = node.raylet_socket_name
        probes[_RAYLET] = lambda: _answers(socket.AF_UNIX, raylet)
        return cls(probes, _CLUSTER_GRACE_S)

    def __getstate__(self) -> dict[str, Any]:
        # Tune pickles who asks it into a file that is never read back here; threads can't be.
        return {}

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._over.set()

    def check(self) -> None:
        """Go on if Ray lives.

        Raises:
            RayDiedError: It does not; the error names what died.
        """
        if self._dead is not None:
            raise RayDiedError(self._dead)

    def check_after(self, failure: BaseException | None) -> None:
        """Find out whether something failed because a part of Ray died; if one is silent, wait until that is certain.

        Args:
            failure: What was raised; what came from a trial itself is none of Ray's.

        Raises:
            RayDiedError: It did.
        """
        if isinstance(failure, RayTaskError):
            return
        self.look()
        while self._silent_since and self._dead is None:
            time.sleep(self._grace_s / 16)
            self.look()
        self.check()

    def look(self) -> None:
        """Ask each part."""
        for name, answers in self._probes.items():
            if answers():
                self._silent_since.pop(name, None)
            elif self._clock() - self._silent_since.setdefault(name, self._clock()) >= self._grace_s:
                self._dead = name

    def _run(self) -> None:
        # Not more often: a raylet writes a line into its log whenever somebody asks and leaves.
        while self._dead is None and not self._over.wait(self._grace_s / 4):
            self.look()
        if self._dead is not None and not self._over.wait(self._stuck_s) and self.when_stuck is not None:
            self.when_stuck(RayDiedError(self._dead))


def _answers(family: int, address: tuple[str, int] | str) -> bool:
    try:
        with socket.socket(family, socket.SOCK_STREAM) as connection:
            connection.settimeout(_CONNECT_TIMEOUT_S)
            connection.connect(address)
    except OSError:
        return False
    return True

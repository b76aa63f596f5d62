"""Watch the processes of Ray: end them if Ray does not start, and notice when one has died."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import ray
from ray.exceptions import RayError, RayTaskError

from policies.errors import CannotRunError
from tune_jobs.process.interruption import current

_CONNECT_TIMEOUT_S = 5.0
# A cluster's operator may need a while to restart the control process. Ray 2.60 ends a process that has not reached
# it for a minute, even if that process still has to save.
_OWN_GRACE_S, _CLUSTER_GRACE_S = 4.0, 15.0

# A block that is told so is left at once, unless it waits in a native call that only Ray could end.
_STUCK_S = 20.0
_STOPPING_S = 5.0

_CONTROL, _RAYLET = "control process (GCS)", "process on this node (raylet)"


@contextlib.contextmanager
def ending_if_it_fails() -> Iterator[None]:
    """If the block fails, end the processes of Ray that it started; a Ray that is not up yet does not end them."""
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
    """Return the ids of this process's children that run one of Ray's programs."""
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
    """A part of Ray is gone. It is not an Exception, because Ray Tune would clean up after one, and wait for Ray."""


def ray_died(command: str, death: RayDiedError) -> CannotRunError:
    """Return the error that reports the death of a part of Ray.

    Args:
        command: What goes on with the sweep.
        death: The part that died.
    """
    return CannotRunError(
        f"Ray's {death} died, or does not answer any more, so no trial can run on it.",
        f"Check whether the machine ran out of memory. What is done is kept; continue with `{command}`.",
    )


class RayWatch:
    """Notices in the background that a part of Ray does not answer any more; a context manager.

    Args:
        probes: For each part's name, a function that says whether the part answers.
        grace_s: Seconds without an answer after which a part is dead.
        clock: A monotonic clock, in seconds.
        stuck_s: Seconds after that after which the block counts as stuck.
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
        """Called in the background if the block is stuck although a part is dead, as Ray would end the process soon."""
        self.hurries: Callable[[], bool] = lambda: False
        """Whether the block was asked to end: it counts as stuck sooner, as who asked may soon kill the process."""
        self._thread = threading.Thread(target=self._run, name="tune-jobs-ray-watch", daemon=True)

    @classmethod
    def of_this_process(cls) -> RayWatch:
        """Return a watch over the Ray that this process is connected to."""
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
        # Tune pickles the users of this object into a file that is never read back; threads can't be pickled.
        return {}

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._over.set()

    def check(self) -> None:
        """Raise an error unless Ray is alive.

        Raises:
            RayDiedError: It is not alive; the error names what died.
        """
        if self._dead is not None:
            raise RayDiedError(self._dead)

    def check_after(self, failure: BaseException | None) -> None:
        """Find out whether the death of a part of Ray caused a failure; if one is silent, wait until that is certain.

        Args:
            failure: The error that was raised; Ray causes an error of a trial itself only if it is one of Ray's own,
                as when the trial's env runners are gone.

        Raises:
            RayDiedError: A part of Ray died.
        """
        if isinstance(failure, RayTaskError) and not isinstance(failure.cause, RayError):
            return
        self.look()
        while self._silent_since and self._dead is None:
            time.sleep(self._grace_s / 16)
            self.look()
        self.check()

    def look(self) -> None:
        """Ask each part whether it answers."""
        for name, answers in self._probes.items():
            if answers():
                self._silent_since.pop(name, None)
            elif self._clock() - self._silent_since.setdefault(name, self._clock()) >= self._grace_s:
                self._dead = name

    def _run(self) -> None:
        # Not more often, because a raylet writes a line into its log for each such connection.
        while self._dead is None and not self._over.wait(self._grace_s / 4):
            self.look()
        if self._dead is None or self.when_stuck is None:
            return
        since = time.monotonic()
        while not self._over.wait(min(self._grace_s, self._stuck_s) / 4):
            # Asked each time: a part may be dead before anybody asks for the end.
            if time.monotonic() - since >= (min(self._stuck_s, _STOPPING_S) if self.hurries() else self._stuck_s):
                self.when_stuck(RayDiedError(self._dead))
                return


def _answers(family: int, address: tuple[str, int] | str) -> bool:
    try:
        with socket.socket(family, socket.SOCK_STREAM) as connection:
            connection.settimeout(_CONNECT_TIMEOUT_S)
            connection.connect(address)
    except OSError:
        return False
    return True

"""A small process beside a driver that started Ray; it ends what Ray leaves behind when the driver is killed.

The kernel ends most of Ray's processes together with the driver, but not the two agents that a raylet starts: in Ray
2.60 they first try for a minute to reach the control process (GCS), which is gone too. This process reads a pipe that
only the driver holds open. Meanwhile it notes which processes the driver's raylet has started, and when the pipe is
closed, it kills those that still run.

It is run by its path, so that it loads nothing else of this package.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

_RAYLET = "raylet"
_NUM_AGENTS = 2
# The first is used until the agents run, the second afterwards, as trials' processes come and go.
_EAGER_S, _INTERVAL_S = 0.1, 1.0
_PATIENCE_S = 10.0


@contextlib.contextmanager
def reaping() -> Iterator[None]:
    """End what the block's Ray started, after the block or if this process is killed in it."""
    if sys.platform != "linux":
        yield
        return
    # A session of its own, so that signals to the driver's process group do not reach it.
    process = subprocess.Popen(  # noqa: S603 (this very file)
        [sys.executable, "-I", "-S", str(Path(__file__))],
        stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    assert process.stdin is not None
    try:
        yield
    finally:
        process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_PATIENCE_S)


def _children(pid: int) -> list[int]:
    found = []
    for listing in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            found += [int(child) for child in listing.read_text(encoding="ascii").split()]
    return found


def _started(pid: int) -> str:
    """Return when a process started; empty if it has ended."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    fields = stat.rpartition(")")[2].split()
    return "" if fields[0] in "ZX" else fields[19]


def _is_raylet(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/comm").read_text(encoding="utf-8", errors="replace").strip() == _RAYLET
    except OSError:
        return False


def _watch(driver: int) -> dict[int, str]:
    """Wait until the driver has closed the pipe, and return what its raylets have started, and when."""
    known: dict[int, str] = {}
    while True:
        now = {child: _started(child) for pid in _children(driver) if _is_raylet(pid) for child in _children(pid)}
        known = {pid: started for pid, started in known.items() if _started(pid) == started} | now
        _call_this_process(f"reaper of {len(known)}")
        pause_s = _INTERVAL_S if len(known) >= _NUM_AGENTS else _EAGER_S
        ready, _, _ = select.select([0], [], [], pause_s)
        if ready and not os.read(0, 1):
            return known


def _call_this_process(name: str) -> None:
    """Name this process, for people who look at the processes of this machine."""
    with contextlib.suppress(OSError):
        Path("/proc/self/comm").write_text(name, encoding="ascii")


def main() -> None:
    """Wait for the driver's end, then end what it left behind."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    for pid, started in _watch(os.getppid()).items():
        if started and _started(pid) == started:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)


if __name__ == "__main__":
    main()

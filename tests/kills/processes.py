"""Everything that a command has started, what of it is left, and that it ends with who started it."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Self

_PR_SET_PDEATHSIG = 1
# Loaded before there are threads: a child that was just forked may only call it.
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None


def end_with_parent(number: int = signal.SIGKILL) -> None:
    """Let the kernel send this process a signal once the thread that started it has ended; call it in a child."""
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, number)


def _table() -> dict[int, tuple[int, str]]:
    """Of each process that runs: its parent, and when it started."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = path.read_text(errors="replace").rpartition(")")[2].split()
            if fields[0] not in "ZX":
                found[int(path.parent.name)] = int(fields[1]), fields[19]
    return found


class Family:
    """A process and its descendants, also those whose parents have ended; watched by a thread, a context manager.

    Args:
        root: The process.
    """

    def __init__(self, root: int) -> None:
        self._root = root
        self._known: dict[int, str] = {}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Self:
        self.look()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._over.wait(0.1):
            self.look()

    def look(self) -> None:
        """Take in who is new."""
        table = _table()
        family = {pid for pid, started in self._known.items() if table.get(pid, (0, ""))[1] == started}
        if self._root in table:
            family.add(self._root)
        grows = True
        while grows:
            new = {pid for pid, (parent, _) in table.items() if parent in family} - family
            family |= new
            grows = bool(new)
        self._known |= {pid: table[pid][1] for pid in family if pid not in self._known}

    def alive(self) -> list[int]:
        """Those that still run."""
        table = _table()
        return [pid for pid, started in self._known.items() if table.get(pid, (0, ""))[1] == started]

    def kill_all(self) -> None:
        """SIGKILL to each, the root first."""
        self.look()
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._root, signal.SIGKILL)
        for _ in range(20):
            self.look()
            if not (left := self.alive()):
                return
            for pid in left:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(0.02)

    def wait_until_gone(self, limit_s: float) -> float | None:
        """Seconds until none of them runs any more; None: some still do after the limit."""
        started = time.monotonic()
        while left := self.alive():
            if time.monotonic() - started > limit_s:
                self.left = [f"{pid} {_name(pid)}" for pid in left]
                return None
            time.sleep(0.05)
        return time.monotonic() - started

    left: list[str] = []  # noqa: RUF012 (set once, on the instance)
    """Those that did not end within a limit."""


def _name(pid: int) -> str:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text(errors="replace").replace("\0", " ").strip()[:80]
    return "?"

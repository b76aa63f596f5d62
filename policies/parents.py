"""Processes that end with the one that started them, however that one ends.

A thread looks at the parent, and the kernel sends a signal where it can (Linux): a process that is inside an
environment's C code, which lets no thread run, ends too.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable
from pathlib import Path

_INTERVAL_S = 0.5
_PR_SET_PDEATHSIG = 1


def end_with_parent(
    also: Iterable[Callable[[], bool]] = (), *, parent: int | None = None, by_kernel: bool = True
) -> None:
    """End this process within a second after its parent, or once one of the conditions holds.

    It ends at once and unconditionally, as by SIGKILL: who outlives what it works for must not clean up after others.

    Args:
        also: Further reasons to end, asked twice a second in a thread; one that raises is no reason.
        parent: The parent's process id, where it was known before this process could look; None: it is looked up.
        by_kernel: Whether the kernel may watch too. It watches the very thread of the parent that started this process:
            not where that may end before its process does.
    """
    expected = os.getppid() if parent is None else parent
    if by_kernel and sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    reasons = [lambda: os.getppid() != expected, *also]
    threading.Thread(target=_watch, args=(reasons,), name="end with parent", daemon=True).start()


def _watch(reasons: list[Callable[[], bool]]) -> None:
    never = threading.Event()
    while True:
        for reason in reasons:
            # What can't be asked now may be asked in a moment.
            with contextlib.suppress(Exception):
                if reason():
                    os._exit(1)
        never.wait(_INTERVAL_S)


def this_process() -> str:
    """This process, as `is_gone` knows it again; empty where the system does not tell (no Linux)."""
    try:
        return f"{_here()} {os.getpid()} {_started(os.getpid())}"
    except OSError:
        return ""


def is_gone(process: str) -> bool:
    """Whether a process has ended; False for one that cannot be seen from here: of another machine or container.

    Args:
        process: What `this_process` gave there.
    """
    try:
        if not process.startswith(_here() + " "):
            return False
    except OSError:
        return False
    pid, started = process.split()[-2:]
    try:
        return _started(int(pid)) != started
    except (FileNotFoundError, ProcessLookupError):
        return True


def _here() -> str:
    """This boot of this machine, and in it what sees the same process ids."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return f"{boot} {Path('/proc/self/ns/pid').readlink()}"


def _started(pid: int) -> str:
    """When a process started, in ticks since the boot; one that has ended and is not waited for has not."""
    # After the name, which is in parentheses and may hold anything.
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    return "" if fields[0] in "ZX" else fields[19]

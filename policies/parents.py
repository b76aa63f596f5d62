"""Let processes end with their parent, however the parent ends.

A thread watches the parent, and on Linux the kernel sends a signal too, so that a process ends even inside an
environment's C code, which lets no other thread run.
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

    It ends at once and unconditionally, as by SIGKILL, because a process that outlives its parent must not clean up
    what others may use by then.

    Args:
        also: More conditions, asked twice a second in a thread; one that raises an error counts as not met.
        parent: The parent's process id, where it was known before this process could look; None: it is looked up.
        by_kernel: Whether the kernel may watch too. It watches the thread of the parent that started this process, so
            this must be False where that thread may end before the parent does.
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
            # It is asked again in a moment.
            with contextlib.suppress(Exception):
                if reason():
                    os._exit(1)
        never.wait(_INTERVAL_S)


def this_process() -> str:
    """Return an identifier of this process for `is_gone`; it is empty on systems other than Linux."""
    try:
        return f"{_here()} {os.getpid()} {_started(os.getpid())}"
    except OSError:
        return ""


def is_gone(process: str) -> bool:
    """Whether a process has ended; False for one of another machine or container, which cannot be seen from here.

    Args:
        process: What `this_process` returned in that process.
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
    """Return an identifier of this boot of this machine and of the namespace of process ids."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return f"{boot} {Path('/proc/self/ns/pid').readlink()}"


def _started(pid: int) -> str:
    """Return when a process started, in ticks since the boot; empty for a zombie, which has ended already."""
    # The fields after the process's name, which is in parentheses and may contain anything.
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    return "" if fields[0] in "ZX" else fields[19]

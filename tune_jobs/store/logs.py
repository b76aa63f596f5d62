"""Find the lines of a process's log that tell how it ended: its last lines, or where it hung.

One process after the other appends to a log. Each begins with a line of its own, by which the last process is found. A
process that hangs is ended by faulthandler, which writes the frames of all threads, of which only one thread's matter.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

from policies.envs.faults import Frame, frame_of_env
from policies.files import open_regular

_TAIL_BYTES = 200_000
_CONTINUED = re.compile(rb"process \d+: built from checkpoint (\d+)$")
_TIMEOUT_MARK = "Timeout ("
_FRAME = re.compile(r'  File "(?P<file>.*)", line (?P<line>\d+) in (?P<name>.*)')
# Files with the loops of a trial's own thread, and files from which this package calls an environment's code.
_LOOPS = (
    "/tune_jobs/ray_tune/trainable.py",
    "/tune_jobs/training/trial_loop.py",
    "/tune_jobs/training/trial_steps.py",
    "/tune_jobs/training/pack_loop.py",
    "/tune_jobs/ray_tune/pack_trainable.py",
)
_CALLERS = (
    "/policies/packed/envs/sub_envs.py",
    "/policies/envs/checked.py",
    "/policies/acting/evaluate.py",
    "/policies/envs/make.py",
)


def log_mark(what: str) -> str:
    """Return the beginning of each process's first line, in the log of something such as "trial t0003"."""
    return f"-- {what}, process "


def begin_log(what: str) -> None:
    """Print the line that separates this process's output, which goes to the log, from that of earlier ones."""
    print(f"{log_mark(what)}{os.getpid()}", flush=True)


def built_from(seed: int, checkpoint: Path | None) -> str:
    """Return the line of a trial's log that says from which seed or checkpoint it was built."""
    return f"built from seed {seed}" if checkpoint is None else f"built from checkpoint {checkpoint.name}"


def continued_from(path: Path) -> int | None:
    """Return the first iteration from whose checkpoint a trial continued; None: it never did, or that isn't known.

    Args:
        path: The trial's log. Those that older versions wrote of trials that no pack trained don't say it.
    """
    try:
        with open_regular(path) as file:
            # One line after the other: a log may be larger than the memory.
            return min((int(found[1]) for line in file if (found := _CONTINUED.search(line))), default=None)
    except OSError:
        return None


def log_tail(path: Path, what: str = "", num_lines: int = 15) -> str:
    """Return the lines that say how the last process of a log ended.

    Args:
        path: The log.
        what: The argument of `begin_log`; empty: no first line is looked for.
        num_lines: The most lines, after one that says that the process was ended because it hung.

    Returns:
        The frames of the thread that hung, or the last lines; empty if there is no log.
    """
    try:
        with open_regular(path) as file:
            file.seek(max(0, path.stat().st_size - _TAIL_BYTES))
            lines = file.read().decode("utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    mark = log_mark(what)
    begun = max((index for index, line in enumerate(lines) if what and line.startswith(mark)), default=0)
    lines = lines[begun:]
    hung = max((index for index, line in enumerate(lines) if line.startswith(_TIMEOUT_MARK)), default=None)
    if hung is None:
        return "\n".join(lines[-num_lines:])
    return "\n".join([lines[hung], *_hung_thread(lines[hung + 1 :])[:num_lines]])


def hang_in(tail: str) -> tuple[bool, Frame | None]:
    """Return whether the process of a log's tail hung, and the environment's frame or else the innermost one."""
    first, *lines = tail.splitlines() or [""]
    frames = [
        Frame(found["file"], int(found["line"]), found["name"]) for line in lines if (found := _FRAME.match(line))
    ]
    return first.startswith(_TIMEOUT_MARK), _frame_of_env(frames) if frames else None


def died_by(tail: str, timeout_s: float) -> str:
    """Say why a process that hung was ended; empty if it did not hang.

    Args:
        tail: The result of `log_tail`.
        timeout_s: The sweep's `iteration_timeout_s`.
    """
    has_hung, frame = hang_in(tail)
    if not has_hung:
        return ""
    place = "" if frame is None else f". It hung at {frame}"
    return f"an iteration took longer than iteration_timeout_s ({timeout_s:g} s){place}"


def _hung_thread(lines: list[str]) -> list[str]:
    """Return the frames of the trial's own thread; faulthandler writes the main thread last."""
    threads: list[list[str]] = [[]]
    for line in lines:
        if line.startswith(("Thread 0x", "Current thread 0x")):
            threads.append([])
        if line.strip():
            threads[-1].append(line)
    own = [thread for thread in threads if any(f'{name}"' in line for line in thread for name in _LOOPS)]
    return (own or threads)[-1]


def _frame_of_env(frames: list[Frame]) -> Frame:
    """Return the env's own frame if it was called, else the innermost one."""
    callers = [index for index, frame in enumerate(frames) if frame.file.endswith(_CALLERS)]
    return (frame_of_env(frames[: callers[0]]) if callers else None) or frames[0]

"""Wall time, memory and first output of a command and all processes below it (Linux)."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Run:
    """One run of a command."""

    wall_s: float
    peak_bytes: int
    """Largest sum of the proportional set sizes of its processes; shared memory counts once."""
    first_match_s: float | None
    output: str


def run(command: Sequence[str], *, cwd: Path, first: str | None = None, terminal: bool = False) -> Run:
    """Run a command to its end.

    Args:
        command: Program and arguments.
        cwd: Working directory.
        first: Regular expression; when it first appears in the output is measured.
        terminal: Give it a terminal, as a person has.

    Raises:
        RuntimeError: It failed.
    """
    start = time.perf_counter()
    reader, writer = pty.openpty() if terminal else os.pipe()
    environment = {**os.environ, "COLUMNS": "150", "LINES": "50", "TERM": "xterm"}
    process = subprocess.Popen(command, cwd=cwd, stdout=writer, stderr=writer, env=environment)
    os.close(writer)
    memory = _Memory(process.pid)
    memory.start()
    output, first_match = "", None
    while True:
        try:
            data = os.read(reader, 65536)
        except OSError:  # a terminal whose last writer has gone
            break
        if not data:
            break
        output += data.decode(errors="replace")
        if first is not None and first_match is None and re.search(first, output):
            first_match = time.perf_counter() - start
    code = process.wait()
    wall = time.perf_counter() - start
    memory.stop()
    os.close(reader)
    if code != 0:
        raise RuntimeError(f"{' '.join(command)} ended with {code}:\n{output[-3000:]}")
    return Run(wall, memory.peak_bytes, first_match, output)


class _Memory(threading.Thread):
    """Samples the memory of a process and its descendants once a second."""

    def __init__(self, pid: int) -> None:
        super().__init__(daemon=True)
        self.peak_bytes = 0
        self._pid = pid
        self._over = threading.Event()

    def run(self) -> None:
        while not self._over.wait(1.0):
            self.peak_bytes = max(self.peak_bytes, sum(_pss(pid) for pid in _tree(self._pid)))

    def stop(self) -> None:
        self._over.set()
        self.join()


def _tree(root: int) -> set[int]:
    parents: dict[int, int] = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                fields = (folder / "stat").read_text().rsplit(")", 1)[1].split()
            except OSError:
                continue
            parents[int(folder.name)] = int(fields[1])
    found = {root}
    while more := {pid for pid, parent in parents.items() if parent in found} - found:
        found |= more
    return found


def _pss(pid: int) -> int:
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    except OSError:
        return 0
    match = re.search(r"^Pss:\s+(\d+) kB", text, re.MULTILINE)
    return int(match.group(1)) * 1024 if match else 0

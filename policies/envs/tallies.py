"""How far the trials of this process are, in memory shared with files: it outlives the process, however that ends.

A *tally* counts the env steps and episodes of one trial. Whoever steps its environments adds to it at every step, so it
also knows of the iteration in which an env hangs, raises an error or ends the process, of which nothing is written.
"""

from __future__ import annotations

import contextlib
import mmap
import struct
import time
from dataclasses import dataclass
from pathlib import Path

from policies.files import read_regular

_FORMAT = "=4d"
_SIZE = struct.calcsize(_FORMAT)
_ITERATIONS, _STEPS, _EPISODES, _TIME = range(4)


@dataclass(frozen=True)
class Reached:
    """How far a trial came."""

    num_iterations: int
    """Whole ones."""
    num_env_steps: int
    num_episodes: int
    time_s: float


class Tally:
    """Of one trial; made anew by each process that trains it.

    Args:
        path: Its file. One that is there is replaced: a process that has it and is not gone yet writes into nothing.
            Where it cannot be written, or its file system shares no memory with files, the tally is this process's own.
        begun: Where the trial goes on from.
    """

    def __init__(self, path: Path, begun: Reached) -> None:
        self._path = path
        self._cells = memoryview(bytearray(_SIZE)).cast("d")
        with contextlib.suppress(OSError, ValueError):
            path.unlink(missing_ok=True)
            with path.open("x+b") as file:
                file.write(bytes(_SIZE))
                file.flush()
                self._cells = memoryview(mmap.mmap(file.fileno(), _SIZE)).cast("d")
        self._began = time.perf_counter() - begun.time_s
        self.set(begun)

    def add(self, num_env_steps: int, num_episodes: int) -> None:
        """Count what a step gave."""
        cells = self._cells
        cells[_STEPS] += num_env_steps
        cells[_EPISODES] += num_episodes
        cells[_TIME] = time.perf_counter() - self._began

    def set(self, reached: Reached) -> None:
        """Take what is known better, such as at an iteration's end."""
        cells = self._cells
        cells[_ITERATIONS], cells[_STEPS] = reached.num_iterations, reached.num_env_steps
        cells[_EPISODES], cells[_TIME] = reached.num_episodes, reached.time_s

    @property
    def reached(self) -> Reached:
        """What it says now."""
        return _reached(*self._cells)

    def remove(self) -> None:
        """Delete the file: what it says is written elsewhere."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)


def read_tally(path: Path) -> Reached | None:
    """What a tally's file says; None: there is none, or it is none."""
    try:
        return _reached(*struct.unpack(_FORMAT, read_regular(path, _SIZE)))
    except (OSError, struct.error, ValueError, OverflowError):
        return None


def _reached(iterations: float, steps: float, episodes: float, time_s: float) -> Reached:
    return Reached(int(iterations), int(steps), int(episodes), time_s)


_tallies: dict[str, Tally] = {}


def begin_tally(trial_id: str, path: Path, begun: Reached) -> Tally:
    """Let those who step a trial's environments in this process count; see `Tally`."""
    tally = _tallies[trial_id] = Tally(path, begun)
    return tally


def end_tally(trial_id: str) -> None:
    """Count a trial no more."""
    _tallies.pop(trial_id, None)


def tally_of(trial_id: str) -> Tally | None:
    """Of a trial that this process trains."""
    return _tallies.get(trial_id)


def only_tally() -> Tally | None:
    """Of the one trial that this process trains; None if there is none, or are several."""
    return next(iter(_tallies.values())) if len(_tallies) == 1 else None

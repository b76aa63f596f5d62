"""Count how far the trials of this process are, in files mapped into memory, which outlive the process.

A *tally* counts the env steps and episodes of one trial. The code that steps the trial's environments adds to it at
every step. So it also counts the iteration in which an env hangs, raises an error or ends the process, for which no
result is written.
"""

from __future__ import annotations

import contextlib
import mmap
import struct
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from policies.files import read_regular

_FORMAT = "=5d"
_SIZE = struct.calcsize(_FORMAT)
_ITERATIONS, _STEPS, _EPISODES, _TIME, _EVALUATES = range(5)


@dataclass(frozen=True)
class Reached:
    """How far a trial has come."""

    num_iterations: int
    """The number of whole episodes."""
    num_env_steps: int
    num_episodes: int
    time_s: float
    evaluates: bool = False
    """Whether it plays the episodes of an evaluation at this moment, which are not counted."""


class Tally:
    """The tally of one trial; each process that trains the trial makes a new one.

    Args:
        path: Its file. An older file is replaced, so an older process that has not ended yet does not write into this
            tally. If the file cannot be written, or the file system cannot map it, the tally is kept in memory only.
        begun: How far the trial is when the process begins.
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
        """Add the env steps and episodes of a step."""
        cells = self._cells
        cells[_STEPS] += num_env_steps
        cells[_EPISODES] += num_episodes
        cells[_TIME] = time.perf_counter() - self._began

    def set(self, reached: Reached) -> None:
        """Set the tally, where better numbers are known, such as at an iteration's end."""
        cells = self._cells
        cells[_ITERATIONS], cells[_STEPS] = reached.num_iterations, reached.num_env_steps
        cells[_EPISODES], cells[_TIME] = reached.num_episodes, reached.time_s

    def set_evaluates(self, *, evaluates: bool) -> None:
        """Set whether the trial plays an evaluation."""
        self._cells[_EVALUATES] = evaluates

    @property
    def reached(self) -> Reached:
        """How far the trial is now."""
        return _reached(*self._cells)

    def remove(self) -> None:
        """Delete the file, once its numbers are written elsewhere."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)


def read_tally(path: Path) -> Reached | None:
    """Read a tally's file; None if there is none, or it is not a tally."""
    try:
        return _reached(*struct.unpack(_FORMAT, read_regular(path, _SIZE)))
    except (OSError, struct.error, ValueError, OverflowError):
        return None


def _reached(iterations: float, steps: float, episodes: float, time_s: float, evaluates: float) -> Reached:
    return Reached(int(iterations), int(steps), int(episodes), time_s, bool(evaluates))


_tallies: dict[str, Tally] = {}


def begin_tally(trial_id: str, path: Path, begun: Reached) -> Tally:
    """Begin to count the steps of a trial that this process trains; see `Tally`."""
    tally = _tallies[trial_id] = Tally(path, begun)
    return tally


def end_tally(trial_id: str) -> None:
    """Stop counting a trial."""
    _tallies.pop(trial_id, None)


def tally_of(trial_id: str) -> Tally | None:
    """Return the tally of a trial, or None if this process does not train it."""
    return _tallies.get(trial_id)


def only_tally() -> Tally | None:
    """Return the tally of the only trial that this process trains; None if there are none or several."""
    return next(iter(_tallies.values())) if len(_tallies) == 1 else None


@contextlib.contextmanager
def evaluating(trial_ids: Iterable[str]) -> Iterator[None]:
    """Let the tallies of some trials say that they are evaluated while the block runs."""
    tallies = [tally for trial_id in trial_ids if (tally := tally_of(trial_id)) is not None]
    for tally in tallies:
        tally.set_evaluates(evaluates=True)
    try:
        yield
    finally:
        for tally in tallies:
            tally.set_evaluates(evaluates=False)

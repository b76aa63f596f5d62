"""Read what was appended to a `results.jsonl` since it was read last, without reading the rest again.

A trial's process appends to the file; one that continues from a checkpoint replaces it by its beginning. What was read
before is still there if it is the same file, and the line that was read last still ends where it did.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from io import BufferedReader
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from analysis.records import Count, Iteration, finite_or_none
from policies.errors import CheckpointError
from policies.files import open_regular
from tune_jobs.store.places import stamp_of
from tune_jobs.store.results_file import MAX_BYTES, agreeing


class CurvePoint(BaseModel):
    """An iteration as a point of learning curves; the other fields of its line are not looked at."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    iteration: Iteration
    num_env_steps: Count
    training_return: float | None = None
    evaluation_return: float | None = None

    @field_validator("training_return", "evaluation_return")
    @classmethod
    def _finite(cls, value: float | None) -> float | None:
        return finite_or_none(value)


@dataclass(frozen=True)
class ResultsMark:
    """How far somebody has read a trial's results; what it holds concerns the store alone."""

    stamp: tuple[int, ...] = ()
    """Of the file; the same one means that nothing was written."""
    offset: int = 0
    """Bytes of the whole lines that were read."""
    line_begin: int = 0
    """Where the last of them begins."""
    line: bytes = b""
    """A hash of it, by which it is known again."""
    iteration: int = -1
    num_env_steps: int = 0


@dataclass(frozen=True)
class NewPoints:
    """What a trial's results hold since they were read last."""

    points: Sequence[CurvePoint]
    mark: ResultsMark
    replaced: bool = False
    """Whether what was read before is no more, and `points` are all that there are."""


def read_new_points(path: Path, since: ResultsMark) -> NewPoints:
    """Read the lines behind a mark; half a line at the end waits for the next time.

    Lines that can't be read are left out. A line that contradicts those before it has all of them weighed anew, as
    `read_results` does, and then all points are returned.

    Raises:
        CheckpointError: The file exists but cannot be read at all.
    """
    if since.stamp and stamp_of(path) == since.stamp:
        return NewPoints((), since)
    try:
        with open_regular(path) as file:
            found = os.fstat(file.fileno())
            stamp = (found.st_ino, found.st_size, found.st_mtime_ns)
            if found.st_size > MAX_BYTES:
                raise CheckpointError(
                    f"{path} has {found.st_size:,} bytes, and no more than {MAX_BYTES:,} are read.", "Move it away."
                )
            if _is_there(file, stamp, since):
                file.seek(since.offset)
                data = file.read()
                points = _points(_lines(data))
                if _follow(points, since):
                    return NewPoints(points, _mark(stamp, since, data, points))
            file.seek(0)
            data = file.read()
    except FileNotFoundError:
        return NewPoints((), ResultsMark(), replaced=since.offset > 0)
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror or error}.", "Move it away.") from error
    points = agreeing(_points(_lines(data)))
    return NewPoints(points, _mark(stamp, ResultsMark(), data, points), replaced=since.offset > 0)


def _is_there(file: BufferedReader, stamp: tuple[int, ...], since: ResultsMark) -> bool:
    """Whether what was read before a mark is still there."""
    inode, size, _ = stamp
    if not since.offset or since.stamp[0] != inode or size < since.offset:
        return False
    # The number of a file that is gone is given to another one.
    file.seek(since.line_begin)
    return _hash(file.read(since.offset - since.line_begin)) == since.line


def _hash(line: bytes) -> bytes:
    return hashlib.blake2b(line, digest_size=16).digest()


def _lines(data: bytes) -> list[bytes]:
    return data.split(b"\n")[:-1]


def _points(lines: Iterable[bytes]) -> list[CurvePoint]:
    found = []
    for line in lines:
        try:
            found.append(CurvePoint.model_validate_json(line))
        except ValidationError:
            continue
    return found


def _follow(points: Sequence[CurvePoint], since: ResultsMark) -> bool:
    """Whether iterations rise and env steps don't fall, from the mark on."""
    iteration, num_env_steps = since.iteration, since.num_env_steps
    for point in points:
        if point.iteration <= iteration or point.num_env_steps < num_env_steps:
            return False
        iteration, num_env_steps = point.iteration, point.num_env_steps
    return True


def _mark(stamp: tuple[int, ...], since: ResultsMark, data: bytes, points: Sequence[CurvePoint]) -> ResultsMark:
    """Return the mark behind the whole lines of what was read behind another mark."""
    end = data.rfind(b"\n") + 1
    if not end:
        return replace(since, stamp=stamp)
    line_begin = data.rfind(b"\n", 0, end - 1) + 1
    line = _hash(data[line_begin:end])
    last = points[-1] if points else since
    begin = since.offset
    return ResultsMark(stamp, begin + end, begin + line_begin, line, last.iteration, last.num_env_steps)

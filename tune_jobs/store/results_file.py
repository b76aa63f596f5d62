"""Read the lines of a `results.jsonl` that can be read, and report the others.

A process that is killed while it writes leaves half a line at the end. Elsewhere, a line that can't be read is damage,
done by the disk, an editor, or two processes that wrote at once. One such line must not make the others unusable:
readers leave it out with a warning, and a process that continues the trial moves it to a file `results.damaged`.

Iterations rise and env steps don't fall; lines that differ from this contradict others. As few lines as possible are
left out so that the others agree: one number that is far too large must not cost all lines after it.
"""

from __future__ import annotations

import json
import re
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar

from pydantic import ValidationError

from analysis.records import IterationRecord
from policies.errors import CheckpointError
from policies.files import read_regular

_BEGINNING = re.compile(rb'\{"iteration":\s*(\d{1,18}),')
"""Matches the iteration in a line as it is written; other lines are parsed to find their iteration."""
_PASSED = re.compile(_BEGINNING.pattern + rb'\s*"num_env_steps":\s*(\d{1,18}),')
"""Matches what of a line shows whether others agree with it."""
_SHOWN_BYTES = 60
MAX_BYTES = 2**30
"""The most bytes that are read, enough for a million iterations."""

Scored = tuple[object, object]
"""Env steps and evaluation return of an iteration."""


@dataclass(frozen=True)
class BadLine:
    """A line that is not a valid result."""

    number: int
    content: bytes
    reason: str

    def __str__(self) -> str:
        """Say which line it is, why it is left out, and how it begins."""
        return f"line {self.number} {self.reason}: {self.content[:_SHOWN_BYTES]!r}"


@dataclass(frozen=True)
class ResultsFile:
    """The content of a results.jsonl."""

    records: list[IterationRecord] = field(default_factory=list)
    """The lines that can be read, with rising iterations."""
    bad: list[BadLine] = field(default_factory=list)
    tail: bytes = b""
    """The bytes after the last newline: part of a line that is being written, or was when its process was killed."""


@dataclass(frozen=True)
class _Passed:
    """A line that was not asked for; the lines after it have to agree with it."""

    iteration: int
    num_env_steps: int


def read_results(path: Path, after: int = -1) -> ResultsFile:
    """Read the lines that can be read; the result is empty if there is no file.

    Args:
        path: The file.
        after: Only lines of later iterations are read; of the others, only the beginning is looked at.

    Raises:
        CheckpointError: The file exists but cannot be read at all.
    """
    try:
        *lines, tail = read_regular(path, MAX_BYTES).split(b"\n")
    except FileNotFoundError:
        return ResultsFile()
    except OSError as error:
        raise CheckpointError(
            f"{path} cannot be read: {error.strerror or error}.",
            "Move it away; the trial continues from its latest checkpoint, without this part of its curve.",
        ) from error
    bad: list[BadLine] = []
    read: list[tuple[int, bytes, IterationRecord | _Passed]] = []
    for number, line in enumerate(lines, start=1):
        try:
            read.append((number, line, _passed(line, after) or IterationRecord.model_validate_json(line)))
        except ValidationError:
            bad.append(BadLine(number, line, "is no result"))
    records = [record for _, _, record in read]
    kept = _agreeing(records)
    bad += _contradictions(read, {read[index][0] for index in kept})
    wanted = [
        record for index in kept if isinstance(record := records[index], IterationRecord) and record.iteration > after
    ]
    return ResultsFile(wanted, sorted(bad, key=lambda line: line.number), tail)


def _passed(line: bytes, after: int) -> _Passed | None:
    """Return the numbers of a line that was not asked for; None: it has to be parsed."""
    found = None if after < 0 else _PASSED.match(line)
    return None if found is None or int(found[1]) > after else _Passed(int(found[1]), int(found[2]))


class _Result(Protocol):
    @property
    def iteration(self) -> int: ...

    @property
    def num_env_steps(self) -> int: ...


_ResultT = TypeVar("_ResultT", bound=_Result)


def agreeing(records: Sequence[_ResultT]) -> list[_ResultT]:
    """Return as many as possible of which iterations rise and env steps don't fall."""
    return [records[index] for index in _agreeing(records)]


def _agreeing(records: Sequence[_Result]) -> list[int]:
    kept = _rising([record.iteration for record in records], strictly=True)
    return [kept[index] for index in _rising([records[index].num_env_steps for index in kept], strictly=False)]


def read_scores(path: Path, wanted: Collection[int]) -> dict[int, list[Scored]]:
    """Return the scores of some iterations in a trial's results; lines that cannot be read are left out.

    Raises:
        CheckpointError: The file exists but cannot be read at all.
    """
    found: defaultdict[int, list[Scored]] = defaultdict(list)
    try:
        lines = read_regular(path, MAX_BYTES).split(b"\n")[:-1]
    except FileNotFoundError:
        return found
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror or error}.") from error
    for line in lines:
        begins = _BEGINNING.match(line)
        if begins is not None and int(begins[1]) not in wanted:
            continue
        try:
            data = json.loads(line)
            if data["iteration"] in wanted:
                found[data["iteration"]].append((data["num_env_steps"], data["evaluation_return"]))
        except (ValueError, LookupError, TypeError, RecursionError):
            continue
    return found


def _contradictions(read: Sequence[tuple[int, bytes, _Result]], kept: set[int]) -> list[BadLine]:
    """Return the lines that can be read but are not kept, each with what it contradicts."""
    found = []
    last: _Result | None = None
    for number, line, record in read:
        if number in kept:
            last = record
        elif last is not None and (record.iteration <= last.iteration or record.num_env_steps < last.num_env_steps):
            found.append(BadLine(number, line, f"does not follow iteration {last.iteration}"))
        else:
            found.append(BadLine(number, line, "contradicts the lines after it"))
    return found


def _rising(values: Sequence[int], *, strictly: bool) -> list[int]:
    """Return the indices of the longest rising (or, if not strictly, not falling) subsequence; the first of several."""
    # From the end: the length of the longest such run from each value on. For each length, the largest value is enough.
    largest: list[int] = []  # negated, so that they are sorted
    counts = []
    for value in reversed(values):
        index = (bisect_left if strictly else bisect_right)(largest, -value)
        largest[index : index + 1] = [-value]
        counts.append(index + 1)
    counts.reverse()
    chosen: list[int] = []
    wanted = len(largest)
    for index, count in enumerate(counts):
        if count == wanted and (not chosen or values[chosen[-1]] + strictly <= values[index]):
            chosen.append(index)
            wanted -= 1
    return chosen

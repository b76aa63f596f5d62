"""What can be read of a `results.jsonl`, and what can't.

A process that is killed while it writes leaves half a line at the end. Elsewhere a line that can't be read is damage:
of the disk, an editor, or two processes that wrote at once. One such line must not cost the others: who reads leaves it
out and says so; who goes on with the trial moves it to a file of its own, `results.damaged`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

from analysis.records import IterationRecord

_SHOWN_BYTES = 60


@dataclass(frozen=True)
class BadLine:
    """A line that is no result."""

    number: int
    content: bytes
    reason: str

    def __str__(self) -> str:
        """Which line it is, why it is left out, and how it begins."""
        return f"line {self.number} {self.reason}: {self.content[:_SHOWN_BYTES]!r}"


@dataclass(frozen=True)
class ResultsFile:
    """The content of a results.jsonl."""

    records: list[IterationRecord] = field(default_factory=list)
    """The lines that can be read, iterations rising."""
    bad: list[BadLine] = field(default_factory=list)
    tail: bytes = b""
    """After the last line's end: of a line that is being written, or was when its process was killed."""


def read_results(path: Path) -> ResultsFile:
    """Read what can be read; an empty one if there is no file.

    Raises:
        OSError: It is there and cannot be read at all.
    """
    try:
        *lines, tail = path.read_bytes().split(b"\n")
    except FileNotFoundError:
        return ResultsFile()
    found = ResultsFile(tail=tail)
    for number, line in enumerate(lines, start=1):
        try:
            record = IterationRecord.model_validate_json(line)
        except ValidationError:
            found.bad.append(BadLine(number, line, "is no result"))
            continue
        last = found.records[-1] if found.records else None
        if last is not None and not (record.iteration > last.iteration and record.num_env_steps >= last.num_env_steps):
            found.bad.append(BadLine(number, line, f"does not follow iteration {last.iteration}"))
            continue
        found.records.append(record)
    return found

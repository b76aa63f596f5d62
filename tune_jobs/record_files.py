"""The files of a sweep folder that are one record each, as JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from analysis.records import FORMAT_VERSION
from policies.errors import CheckpointError, NotFoundError

_RecordT = TypeVar("_RecordT", bound=BaseModel)


def dump(record: BaseModel, indent: int | None = 1) -> str:
    """A record as it is written, with the end of its last line."""
    return record.model_dump_json(indent=indent) + "\n"


def read_record(path: Path, kind: type[_RecordT], what: str) -> _RecordT:
    """Read a record.

    Args:
        path: Its file.
        kind: What it must be.
        what: What to call it in messages.

    Raises:
        NotFoundError: There is no such file.
        CheckpointError: It is damaged or of a newer format; the message names it.
    """
    try:
        data = json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise NotFoundError(f"No {what} at {path}.", "List the sweeps here with `tune-jobs list`.") from error
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"{path} cannot be read as {what}: {error}.",
            "Restore the file from a backup, or delete the folder.",
        ) from error
    version = data.get("format_version", FORMAT_VERSION) if isinstance(data, dict) else FORMAT_VERSION
    if version > FORMAT_VERSION:
        raise CheckpointError(
            f"{path} has format version {version}; this tune-jobs reads up to {FORMAT_VERSION}.",
            "Upgrade tune-jobs: `pip install --upgrade tune-jobs`.",
        )
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        raise CheckpointError(f"{path} is not a valid {what}: {error}.", "Restore the file from a backup.") from error

"""Read and write the files of a sweep folder that hold one record each, as JSON.

Records by which a winner is chosen are *sealed*: they include the SHA-256 of everything else in them, as JSON with
sorted keys and without spaces. Format 1 had no seals.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from pydantic import BaseModel, ValidationError

from analysis.records import FORMAT_VERSION, SEALED_FORMAT_VERSION
from policies.errors import UPGRADE, CheckpointError, NotFoundError
from policies.files import read_regular
from policies.wrong_values import details_of, dotted, explain

_RecordT = TypeVar("_RecordT", bound=BaseModel)

_SEAL = "sha256"
_FIRST_SEALED_VERSION = 2
_BACKUP = "Restore the file from a backup."
_MAX_DEPTH = 256
"""The most nested lists and mappings; sweep files may have fewer, and no record adds many."""


def dump(record: BaseModel, indent: int | None = 1) -> str:
    """Return a record as it is written, with a newline at the end."""
    return record.model_dump_json(indent=indent) + "\n"


def dump_sealed(record: BaseModel, **more: Any) -> str:
    """Return a record as it is written, with more fields and a seal."""
    data = json.loads(record.model_dump_json()) | more | {"format_version": SEALED_FORMAT_VERSION}
    return json.dumps({**data, _SEAL: seal(data)}, indent=1) + "\n"


def seal(data: dict[str, Any]) -> str:
    """Return the hash of everything in a file except the hash itself."""
    content = {name: value for name, value in data.items() if name != _SEAL}
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def read_record(path: Path, kind: type[_RecordT], what: str, *, is_sealed: bool = False) -> _RecordT:
    """Read a record.

    Args:
        path: Its file.
        kind: Its class.
        what: Its name in messages.
        is_sealed: Whether it has to have a seal.

    Raises:
        NotFoundError: There is no such file.
        CheckpointError: It is damaged, of a newer format, or was changed; the message names the file and the field.
    """
    return parse_record(read_json(path, what, is_sealed=is_sealed), path, kind, what)


def read_json(path: Path, what: str, *, is_sealed: bool = False) -> dict[str, Any]:
    """Read the fields of a record; see `read_record`."""
    try:
        data = json.loads(read_regular(path), object_pairs_hook=_once_each, parse_constant=_refuse_constant)
        # Half a pair of surrogates is valid JSON, but cannot be printed or written again.
        json.dumps(data, ensure_ascii=False).encode()
        _refuse_depth(data)
    except FileNotFoundError as error:
        raise NotFoundError(f"No {what} at {path}.", "List the sweeps here with `tune-jobs list`.") from error
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(
            f"{path} cannot be read as {what}: {(error.strerror if isinstance(error, OSError) else None) or error}.",
            "Restore the file from a backup, or delete the folder.",
        ) from error
    if not isinstance(data, dict):
        raise CheckpointError(f"{path} is not a valid {what}: it is not a JSON object.", _BACKUP)
    version = data.get("format_version", FORMAT_VERSION)
    if type(version) is not int or version < 1:
        raise CheckpointError(f"{path} is not a valid {what}: format_version is {version!r:.80}.", _BACKUP)
    if version > FORMAT_VERSION:
        raise CheckpointError(
            f"{path} has format version {version}; this tune-jobs reads up to {FORMAT_VERSION}.",
            UPGRADE,
        )
    if is_sealed and (version >= _FIRST_SEALED_VERSION or _SEAL in data) and data.get(_SEAL) != _seal_of(data):
        raise CheckpointError(
            f"{path} is not the {what} that was written (its SHA-256 differs).",
            "Restore the file from a backup: its present content is not used.",
        )
    return data


def _once_each(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object, or refuse it if a name occurs twice, as different readers would use different values."""
    data = dict(pairs)
    if len(data) < len(pairs):
        times = Counter(name for name, _ in pairs)
        twice = next(name for name in data if times[name] > 1)
        raise ValueError(f"{twice[:80]!r} occurs twice")
    return data


def _refuse_depth(data: Any) -> None:
    layer = [data]
    for _ in range(_MAX_DEPTH):
        layer = [
            inner for value in layer if isinstance(value, dict | list)
            for inner in (value.values() if isinstance(value, dict) else value)
        ]  # fmt: skip
        if not layer:
            return
    raise ValueError(f"it is nested more than {_MAX_DEPTH} deep")


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON")


def _seal_of(data: dict[str, Any]) -> str | None:
    try:
        return seal(data)
    except (ValueError, RecursionError):
        return None


def parse_record(data: dict[str, Any], path: Path, kind: type[_RecordT], what: str) -> _RecordT:
    """Return the record that was read from a file.

    Raises:
        CheckpointError: It is not valid; the message names the file and the field.
    """
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        raise CheckpointError(f"{path} is not a valid {what}: {problems_in(error)}", _BACKUP) from error
    except (RecursionError, OverflowError) as error:
        raise CheckpointError(f"{path} is not a valid {what}: {error}.", _BACKUP) from error


def problems_in(error: ValidationError) -> str:
    """Return the first field that is wrong, why it is, and how many more there are."""
    first, *others = details_of(error)
    text = f"{dotted(first['loc'])} {explain(first)}."
    return text.strip()[:300] + (f" (and {len(others)} more)" if others else "")

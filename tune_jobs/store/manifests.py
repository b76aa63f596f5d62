"""Write and check manifests, which list the files of a checkpoint folder and its scores.

A manifest names every file of the folder with its size and hash. Since format 2 it includes a hash of itself, so that
an edited score is noticed. This is not a signature: anyone who may write to the folder can write another manifest with
its hash. The score is in `results.jsonl` too, and `tune_jobs.store.candidates` compares both.
"""

from __future__ import annotations

import re
from collections.abc import Container
from pathlib import Path, PurePosixPath
from typing import Any

from analysis.records import CheckpointRecord
from policies.errors import CheckpointError, NotFoundError
from policies.files import refuse_others, sha256_file, sync, write_plain
from tune_jobs.store.names import MANIFEST
from tune_jobs.store.places import parts_below, refuse_link, within
from tune_jobs.store.presence import is_file, is_folder
from tune_jobs.store.record_files import dump_sealed, parse_record, read_json

_POLICY_FILES = ("policy.json", "policy.safetensors")
_SHA256 = re.compile(r"[0-9a-f]{64}")
# What Finder and Explorer leave in a folder that is looked at, and NFS for a file that was deleted while it was open.
_OF_THE_SYSTEM = re.compile(r"\.DS_Store|Thumbs\.db|desktop\.ini|\.nfs[0-9a-f]+")
# Where a file system has no room for it, what macOS knows of a file X is in a file ._X beside it.
_BESIDE = re.compile(r"\._(.*[^.].*)")
_HINT = "Use another checkpoint of the trial, or restore the file from a backup."


def write_manifest(folder: Path, record: CheckpointRecord, engine: str = "") -> None:
    """Write the manifest of a filled checkpoint folder that is not visible yet, and wait until all is on disk.

    Args:
        folder: The folder.
        record: The checkpoint's record, with its scores.
        engine: Name of the engine that wrote it; empty: not known, and left out.
    """
    files = {
        name: {"bytes": path.stat().st_size, "sha256": sha256_file(path)} for name, path in _files_in(folder).items()
    }
    named = {"engine": engine} if engine else {}
    write_plain(folder / MANIFEST, dump_sealed(record, **named, files=files))
    sync_folder(folder)


def sync_folder(folder: Path) -> None:
    """Wait until a folder is on disk with all that is in it."""
    for path in [*parts_below(folder), folder]:
        sync(path)


def is_checkpoint(folder: Path) -> bool:
    """Whether a folder is a checkpoint's, judged by whether it has a manifest, which is not read.

    Raises:
        CheckpointError: This cannot be found out.
    """
    # The folder first, so that an error names what was given.
    return is_folder(folder) and is_file(folder / MANIFEST)


def read_manifest(checkpoint: Path) -> CheckpointRecord:
    """Read the record in a checkpoint's manifest.

    Raises:
        NotFoundError: The folder or its manifest is missing.
        CheckpointError: The manifest is damaged, or was changed after it was written.
    """
    return _read(checkpoint)[0]


def read_engine_name(checkpoint: Path) -> str | None:
    """Read the engine's name in a checkpoint's manifest; None: the manifest is of a version without names.

    Raises:
        NotFoundError: The folder or its manifest is missing.
        CheckpointError: The manifest is damaged, or was changed after it was written.
    """
    engine: str | None = _read(checkpoint)[1].get("engine")
    return engine


def verify_checkpoint(checkpoint: Path) -> CheckpointRecord:
    """Check every file of a checkpoint against its manifest, before anything in it is read.

    Raises:
        NotFoundError: The folder is missing, or was removed meanwhile: the trial keeps only its last ones.
        CheckpointError: A file is missing, cannot be read, differs in size or hash, or is not in the manifest; the
            message names it.
    """
    try:
        return _verified(checkpoint)
    except (OSError, CheckpointError) as error:
        if not is_folder(checkpoint):
            raise _no_folder(checkpoint) from None
        if isinstance(error, CheckpointError):
            raise
        text = f"Checkpoint {checkpoint} cannot be read: {error.strerror}, {error.filename}."
        raise CheckpointError(text, "Use another checkpoint of the trial.") from error


def _verified(checkpoint: Path) -> CheckpointRecord:
    record, data = _read(checkpoint)
    files = _described_files(checkpoint / MANIFEST, data.get("files"))
    found = _files_in(checkpoint)
    for name in sorted(found.keys() - files.keys()):
        raise CheckpointError(
            f"Checkpoint {checkpoint} holds the file {name}, which its {MANIFEST} does not name.",
            "Remove the file if you know it, or use another checkpoint of the trial.",
        )
    for name, (size, digest) in files.items():
        if name not in found:
            raise CheckpointError(
                f"Checkpoint {checkpoint} lacks the file {name}.", "Use another checkpoint of the trial."
            )
        if found[name].stat().st_size != size or sha256_file(found[name]) != digest:
            raise CheckpointError(
                f"Checkpoint {checkpoint}: the file {name} is not the one that was written (its SHA-256 differs).",
                _HINT,
            )
    return record


def described_files(checkpoint: Path) -> list[str]:
    """Return the names of a checkpoint's files, as its manifest has them; they need not be there.

    Raises:
        NotFoundError: The folder or its manifest is missing.
        CheckpointError: The manifest is damaged, or was changed after it was written.
    """
    return sorted(_described_files(checkpoint / MANIFEST, _read(checkpoint)[1].get("files")))


def files_of(checkpoint: Path) -> dict[str, Path]:
    """Return the files of a checkpoint by their names, its manifest first.

    Raises:
        CheckpointError: Something in it is a symbolic link, or neither a file nor a folder.
    """
    return {MANIFEST: within(checkpoint, MANIFEST), **_files_in(checkpoint)}


def _read(checkpoint: Path) -> tuple[CheckpointRecord, dict[str, Any]]:
    if not is_folder(checkpoint):
        raise _no_folder(checkpoint)
    path = checkpoint / MANIFEST
    refuse_link(path)
    if not is_file(path):
        raise CheckpointError(
            f"Checkpoint {checkpoint} has no {MANIFEST}: it is not a checkpoint, or was not completely written.",
            "Use another checkpoint of the trial, or delete this folder.",
        )
    data = read_json(path, "checkpoint manifest", is_sealed=True)
    if not isinstance(engine := data.get("engine"), str | None):
        raise CheckpointError(f"{path}: engine is {_shown(engine)}, not a name.", _HINT)
    return parse_record(data, path, CheckpointRecord, "checkpoint manifest"), data


def _no_folder(checkpoint: Path) -> NotFoundError:
    return NotFoundError(f"No checkpoint folder at {checkpoint}.", "List a sweep's with `tune-jobs trials SWEEP`.")


def _described_files(manifest: Path, files: Any) -> dict[str, tuple[int, str]]:
    """Return size and hash by file name, after checking their form and that the files of every checkpoint are named."""
    if not isinstance(files, dict):
        raise CheckpointError(f"{manifest}: files is {_shown(files)}, not a mapping of names.", _HINT)
    described = {}
    for name, entry in files.items():
        path = PurePosixPath(name)
        # Only names as `write_manifest` writes them: these cannot lead out of the folder, nor name the same file twice.
        if path.is_absolute() or ".." in path.parts or str(path) != name or "\0" in name or not path.parts:
            raise CheckpointError(f"{manifest}: files names {name[:80]!r}, which is not a file in the folder.", _HINT)
        size, digest = (entry.get("bytes"), entry.get("sha256")) if isinstance(entry, dict) else (None, None)
        if type(size) is not int or not isinstance(digest, str) or _SHA256.fullmatch(digest) is None:
            raise CheckpointError(f"{manifest}: files.{name} is {_shown(entry)}, not a size and a SHA-256.", _HINT)
        described[name] = (size, digest)
    for name in _POLICY_FILES:
        if name not in described:
            raise CheckpointError(f"{manifest}: files does not name {name}, which every checkpoint has.", _HINT)
    if len(described) == len(_POLICY_FILES):
        raise CheckpointError(f"{manifest}: files names no state from which training could continue.", _HINT)
    return described


def _files_in(folder: Path) -> dict[str, Path]:
    """Return the files of a checkpoint by name, without its manifest and what systems add of their own accord.

    Raises:
        CheckpointError: Something in it is a symbolic link, or neither a file nor a folder.
    """
    files = {}
    paths = dict.fromkeys(parts_below(folder))
    for path in paths:
        name = path.relative_to(folder).as_posix()
        if name != MANIFEST and not is_folder(path):
            try:
                refuse_others(path.stat(), path)
            except FileNotFoundError:
                # NFS has removed it by now, or somebody else: whoever needs it misses it.
                continue
            except OSError as error:
                raise CheckpointError(f"Checkpoint {folder}: of {name}, {error.strerror}.", _HINT) from error
            if not _is_of_the_system(path, paths):
                files[name] = path
    return files


def _is_of_the_system(path: Path, paths: Container[Path]) -> bool:
    """Whether a file among those of a checkpoint has a name that systems give to their own, which no engine reads."""
    if (beside := _BESIDE.fullmatch(path.name)) is not None:
        return path.with_name(beside[1]) in paths
    return _OF_THE_SYSTEM.fullmatch(path.name) is not None


def _shown(value: Any) -> str:
    return "missing" if value is None else repr(value)[:80]

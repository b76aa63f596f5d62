"""Manifests: what a checkpoint folder holds, and whether it still does."""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path

from analysis.records import FORMAT_VERSION, CheckpointRecord
from policies.errors import CheckpointError, NotFoundError
from policies.files import sha256_file, write_plain
from tune_jobs.record_files import read_record

MANIFEST = "manifest.json"


def write_manifest(folder: Path, record: CheckpointRecord) -> None:
    """Write the manifest of a checkpoint folder that is filled and not seen yet, and wait until all is on disk."""
    files = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            name = path.relative_to(folder).as_posix()
            files[name] = {"bytes": path.stat().st_size, "sha256": sha256_file(path)}
    manifest = {"format_version": FORMAT_VERSION, **record.model_dump(mode="json"), "files": files}
    write_plain(folder / MANIFEST, json.dumps(manifest, indent=1) + "\n")
    for path in [*folder.rglob("*"), folder]:
        _sync(path)


def _sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on disk."""
    # Network file systems may not sync folders.
    with contextlib.suppress(OSError) if path.is_dir() else contextlib.nullcontext():
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def read_manifest(checkpoint: Path) -> CheckpointRecord:
    """The record in a checkpoint's manifest.

    Raises:
        NotFoundError: The folder or its manifest is missing.
        CheckpointError: The manifest is damaged.
    """
    if not checkpoint.is_dir():
        raise NotFoundError(f"No checkpoint folder at {checkpoint}.", "List a sweep's with `tune-jobs trials SWEEP`.")
    if not (checkpoint / MANIFEST).is_file():
        raise CheckpointError(
            f"Checkpoint {checkpoint} has no {MANIFEST}: it is not one, or was not written whole.",
            "Use another checkpoint of the trial, or delete this folder.",
        )
    return read_record(checkpoint / MANIFEST, CheckpointRecord, "checkpoint manifest")


def verify_checkpoint(checkpoint: Path) -> CheckpointRecord:
    """Check every file of a checkpoint against its manifest, before anything in it is read.

    Raises:
        NotFoundError: The folder is missing.
        CheckpointError: A file is missing or differs in size or hash; the message names it.
    """
    record = read_manifest(checkpoint)
    files = json.loads((checkpoint / MANIFEST).read_bytes()).get("files", {})
    for name, expected in files.items():
        path = checkpoint / name
        if not path.is_file():
            raise CheckpointError(
                f"Checkpoint {checkpoint} lacks the file {name}.", "Use another checkpoint of the trial."
            )
        if path.stat().st_size != expected["bytes"] or sha256_file(path) != expected["sha256"]:
            raise CheckpointError(
                f"Checkpoint {checkpoint}: the file {name} is not the one that was written (its SHA-256 differs).",
                "Use another checkpoint of the trial, or restore the file from a backup.",
            )
    return record

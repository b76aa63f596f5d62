"""The sweep folder: who writes what, and how it is read back.

Layout: see `docs/design.md`, "On disk". Who may write: the process that drives a sweep holds the folder's lock and
writes `sweep.json` and every `trial.json`; the process that trains a trial writes that trial's `results.jsonl`,
`checkpoints/` and `log.txt`. Everybody may read at any time: a file appears whole or not at all.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from analysis.records import (
    FORMAT_VERSION,
    BestRecord,
    CheckpointRecord,
    IterationRecord,
    SweepRecord,
    TrialRecord,
)
from policies.errors import CannotRunError, CheckpointError, NotFoundError, SpecError
from policies.files import sha256_file, write_atomic, write_plain
from tune_jobs.locks import held

MANIFEST = "manifest.json"
_RecordT = TypeVar("_RecordT", bound=BaseModel)


def _read_record(path: Path, kind: type[_RecordT], what: str) -> _RecordT:
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


def _dump(record: BaseModel, indent: int | None = 1) -> str:
    return record.model_dump_json(indent=indent) + "\n"


class TrialStore:
    """One trial's folder."""

    def __init__(self, sweep_folder: Path, trial_id: str) -> None:
        self.sweep_folder = sweep_folder
        self.trial_id = trial_id
        self.folder = sweep_folder / "trials" / trial_id
        self.record_path = self.folder / "trial.json"
        self.results_path = self.folder / "results.jsonl"
        self.checkpoints_folder = self.folder / "checkpoints"
        self.log_path = self.folder / "log.txt"

    def read_record(self) -> TrialRecord:
        """trial.json.

        Raises:
            NotFoundError: There is none.
            CheckpointError: It is damaged or of a newer format.
        """
        return _read_record(self.record_path, TrialRecord, "trial record")

    def write_record(self, record: TrialRecord) -> None:
        """Replace trial.json."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomic(self.record_path, _dump(record))

    def append_iterations(self, records: Sequence[IterationRecord]) -> None:
        """Append lines to results.jsonl; a line torn by a kill is dropped when it is read."""
        if not records:
            return
        with self.results_path.open("a", encoding="utf-8") as file:
            file.write("".join(_dump(record, indent=None) for record in records))

    def read_iterations(self) -> list[IterationRecord]:
        """Every whole line of results.jsonl, in order; empty if there is no file."""
        try:
            lines = self.results_path.read_text(encoding="utf-8").split("\n")
        except FileNotFoundError:
            return []
        records = []
        for number, line in enumerate(lines[:-1], start=1):
            try:
                records.append(IterationRecord.model_validate_json(line))
            except ValidationError as error:
                raise CheckpointError(
                    f"{self.results_path}, line {number}, is not a result: {line[:80]!r}.",
                    "Delete that line; the trial's other lines are kept.",
                ) from error
        return records

    def keep_iterations(self, records: Sequence[IterationRecord]) -> None:
        """Replace results.jsonl by these lines: those up to the checkpoint a trial goes on from."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomic(self.results_path, "".join(_dump(record, indent=None) for record in records))

    def checkpoints(self) -> list[CheckpointRecord]:
        """The complete checkpoints, oldest first (those being written have no final name yet)."""
        if not self.checkpoints_folder.is_dir():
            return []
        records = [
            read_manifest(folder)
            for folder in self.checkpoints_folder.iterdir()
            if folder.is_dir() and not folder.name.startswith(".")
        ]
        return sorted(records, key=lambda record: record.iteration)

    def write_checkpoint(self, record: CheckpointRecord, write: Callable[[Path], None]) -> None:
        """Write a checkpoint folder whole: to a hidden name, hashed, synced, then renamed.

        Args:
            record: Its scores and iteration; `record.path` must be `checkpoint_path(record.iteration)`.
            write: Fills the folder it is given.
        """
        target = self.sweep_folder / record.path
        temporary = target.with_name(f".{target.name}.{os.getpid()}")
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        try:
            write(temporary)
            files = {}
            for path in sorted(temporary.rglob("*")):
                if path.is_file():
                    name = path.relative_to(temporary).as_posix()
                    files[name] = {"bytes": path.stat().st_size, "sha256": sha256_file(path)}
            manifest = {"format_version": FORMAT_VERSION, **record.model_dump(mode="json"), "files": files}
            write_plain(temporary / MANIFEST, json.dumps(manifest, indent=1) + "\n")
            for path in [*temporary.rglob("*"), temporary]:
                _sync(path)
            if target.exists():
                # A trial that went on from an earlier checkpoint writes this iteration anew.
                shutil.rmtree(target)
            temporary.replace(target)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise

    def checkpoint_path(self, iteration: int) -> str:
        """Where the checkpoint of an iteration lies, relative to the sweep folder."""
        return f"trials/{self.trial_id}/checkpoints/{iteration:06d}"

    def delete_checkpoint(self, record: CheckpointRecord) -> None:
        """Remove a checkpoint: first from sight, then from disk."""
        folder = self.sweep_folder / record.path
        hidden = folder.with_name(f".{folder.name}.deleted")
        shutil.rmtree(hidden, ignore_errors=True)
        folder.replace(hidden)
        shutil.rmtree(hidden, ignore_errors=True)

    def remove_leftovers(self) -> None:
        """Delete half-written or half-deleted checkpoints of a process that was killed."""
        if self.checkpoints_folder.is_dir():
            for folder in self.checkpoints_folder.iterdir():
                if folder.name.startswith("."):
                    shutil.rmtree(folder, ignore_errors=True)

    def log_tail(self, num_lines: int = 15) -> str:
        """The last lines of the trial's log; empty if there is none."""
        try:
            with self.log_path.open("rb") as file:
                file.seek(max(0, self.log_path.stat().st_size - 20_000))
                lines = file.read().decode("utf-8", errors="replace").splitlines()
        except OSError:
            return ""
        return "\n".join(lines[-num_lines:])


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
    return _read_record(checkpoint / MANIFEST, CheckpointRecord, "checkpoint manifest")


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


class SweepStore:
    """One sweep's folder."""

    def __init__(self, folder: Path) -> None:
        # Ray takes only absolute paths for storage ("URI has empty scheme" otherwise).
        self.folder = folder.absolute()
        self.record_path = self.folder / "sweep.json"
        self.best_folder = self.folder / "best"
        self.report_folder = self.folder / "report"
        self.tune_folder = self.folder / "tune"
        self._stop_path = self.folder / ".stop"
        self._lock_path = self.folder / ".lock"
        self._driver_lock_path = self.folder / ".driver-lock"
        self._made: list[Path] = []

    @property
    def name(self) -> str:
        """The sweep's name: its folder's."""
        return self.folder.name

    def exists(self) -> bool:
        """Whether a sweep lies here."""
        return self.record_path.is_file()

    def create(self) -> None:
        """Make the folder; of several processes that want the same name, one gets it.

        Raises:
            SpecError: It is there already.
            CannotRunError: The storage folder cannot be written.
        """
        root = self.folder.parent
        self._made = [folder for folder in (root, *root.parents) if not folder.exists()]
        try:
            root.mkdir(parents=True, exist_ok=True)
            try:
                self.folder.mkdir()
            except FileExistsError as error:
                raise name_taken(self.folder) from error
            (self.folder / "trials").mkdir()
        except OSError as error:
            reason = os.strerror(error.errno) if error.errno else str(error)
            raise CannotRunError(
                f"The storage folder {root} cannot be written: {reason}.",
                "Choose another with --storage, or set TUNE_JOBS_STORAGE.",
            ) from error

    def discard(self) -> None:
        """Undo `create`: remove the folder, and the folders above it that it made."""
        shutil.rmtree(self.folder, ignore_errors=True)
        with contextlib.suppress(OSError):
            for folder in self._made:
                folder.rmdir()

    def read_record(self) -> SweepRecord:
        """sweep.json.

        Raises:
            NotFoundError: There is none.
            CheckpointError: It is damaged or of a newer format.
        """
        return _read_record(self.record_path, SweepRecord, "sweep")

    def write_record(self, record: SweepRecord) -> None:
        """Replace sweep.json."""
        write_atomic(self.record_path, _dump(record))

    def trial(self, trial_id: str) -> TrialStore:
        """The folder of one trial."""
        return TrialStore(self.folder, trial_id)

    def read_trials(self) -> list[TrialRecord]:
        """Every trial's record, by index."""
        trials_folder = self.folder / "trials"
        if not trials_folder.is_dir():
            return []
        records = [
            self.trial(folder.name).read_record()
            for folder in trials_folder.iterdir()
            if (folder / "trial.json").is_file()
        ]
        return sorted(records, key=lambda record: record.index)

    def read_best(self) -> BestRecord:
        """best/evaluation.json.

        Raises:
            NotFoundError: No best policy has been chosen yet.
        """
        path = self.best_folder / "evaluation.json"
        if not path.is_file():
            raise NotFoundError(
                f"Sweep {self.name} has no best policy yet.", f"Choose it with `tune-jobs best {self.name}`."
            )
        return _read_record(path, BestRecord, "best record")

    def write_best(self, record: BestRecord) -> None:
        """Replace best/evaluation.json."""
        self.best_folder.mkdir(parents=True, exist_ok=True)
        write_atomic(self.best_folder / "evaluation.json", _dump(record))

    def request_stop(self) -> None:
        """Ask the process that drives this sweep to stop."""
        write_atomic(self._stop_path, "stop\n")

    def stop_requested(self) -> bool:
        """Whether somebody asked."""
        return self._stop_path.exists()

    def clear_stop_request(self) -> None:
        """Forget the request."""
        self._stop_path.unlink(missing_ok=True)

    def is_driven(self) -> bool:
        """Whether a process drives this sweep now (on this machine, or on one that shares locks with it)."""
        if not self._lock_path.exists():
            return False
        try:
            with self.lock():
                return False
        except CannotRunError:
            return True

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the sweep's lock; the system frees it when the process ends, however it ends.

        Raises:
            CannotRunError: Another process holds it, or runs the sweep on a cluster.
        """
        watch = f"Watch it with `tune-jobs status {self.name}`, or end it with `tune-jobs stop {self.name}`."
        with held(self._lock_path, f"Sweep {self.name} is being run by another process.", watch):
            with self.driver_lock():
                pass
            yield

    @contextlib.contextmanager
    def driver_lock(self) -> Iterator[None]:
        """Hold the lock of the process on a cluster that drives the sweep for a client, which holds the sweep's lock.

        Raises:
            CannotRunError: Such a process still runs.
        """
        message = f"Sweep {self.name} is still being run on a cluster, for a process that is gone."
        with held(self._driver_lock_path, message, "Try again in a minute: the cluster is ending it."):
            yield


def name_taken(folder: Path) -> SpecError:
    """The error for a new sweep whose folder is there already."""
    return SpecError(
        f"A sweep {folder.name!r} is already in {folder.parent}.",
        f"Choose another name with --name, or go on with it: `tune-jobs resume {folder.name}`.",
    )


def list_sweep_stores(storage: Path) -> list[SweepStore]:
    """The sweeps in a storage folder, by name; empty if there is no such folder."""
    if not storage.is_dir():
        return []
    stores = [SweepStore(folder) for folder in sorted(storage.iterdir()) if folder.is_dir()]
    return [store for store in stores if store.exists()]

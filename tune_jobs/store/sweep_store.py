"""The sweep folder: who writes what, and how it is read back.

Layout: see `docs/design.md`, "On disk". Who may write: the process that drives a sweep holds the folder's lock and
writes `sweep.json` and every `trial.json`; the process that trains a trial writes that trial's `results.jsonl`,
`checkpoints/` and `log.txt`. Everybody may read at any time: a file appears whole or not at all.
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from analysis.records import BestRecord, CheckpointRecord, IterationRecord, SweepRecord, TrialRecord
from policies.errors import CannotRunError, CheckpointError, NotFoundError, SpecError
from policies.files import absolute, open_to_append, write_atomic
from tune_jobs.store.locks import held, is_held
from tune_jobs.store.logs import log_tail
from tune_jobs.store.manifests import MANIFEST, read_manifest, verify_checkpoint, write_manifest
from tune_jobs.store.ownership import OwnedFolder
from tune_jobs.store.places import (
    check_trial_id,
    checkpoint_iteration,
    is_trial_id,
    make_folder,
    parts_of,
    refuse_link,
    refuse_links_in,
    remove_file,
    remove_folder,
    within,
)
from tune_jobs.store.record_files import dump, dump_sealed, read_record
from tune_jobs.store.results_file import read_results

_LOG = logging.getLogger(__name__)

__all__ = [
    "MANIFEST", "SweepStore", "TrialStore", "list_sweep_stores", "name_taken", "read_manifest", "verify_checkpoint",
]  # fmt: skip


class TrialStore(OwnedFolder):
    """One trial's folder; the process that trains the trial has taken it."""

    def __init__(self, sweep_folder: Path, trial_id: str) -> None:
        self.sweep_folder = sweep_folder
        self.trial_id = check_trial_id(trial_id)

    # Looked at anew each time: what is no link now may be one when the trial goes on.

    @property
    def folder(self) -> Path:
        """The trial's folder."""
        return within(self.sweep_folder, "trials", self.trial_id)

    @property
    def record_path(self) -> Path:
        """Of trial.json."""
        return within(self.folder, "trial.json")

    @property
    def results_path(self) -> Path:
        """Of results.jsonl."""
        return within(self.folder, "results.jsonl")

    @property
    def log_path(self) -> Path:
        """Of log.txt."""
        return within(self.folder, "log.txt")

    @property
    def tally_path(self) -> Path:
        """Of the file that says how far a trial is whose process runs, or did not end by itself."""
        return within(self.folder, ".tally")

    @property
    def checkpoints_folder(self) -> Path:
        """Where its checkpoints lie."""
        return within(self.folder, "checkpoints")

    def checkpoint_folder(self, iteration: int) -> Path:
        """Where the checkpoint of an iteration lies, or would."""
        return within(self.checkpoints_folder, f"{iteration:06d}")

    def read_record(self) -> TrialRecord:
        """trial.json.

        Raises:
            NotFoundError: There is none.
            CheckpointError: It is damaged, of a newer format, or another trial's.
        """
        record = read_record(self.record_path, TrialRecord, "trial record")
        if record.trial_id != self.trial_id:
            raise CheckpointError(
                f"{self.record_path} is of trial {record.trial_id}, but lies in the folder of {self.trial_id}.",
                "Restore the file from a backup.",
            )
        return record

    def write_record(self, record: TrialRecord) -> None:
        """Replace trial.json."""
        write_atomic(self.record_path, dump(record))

    def append_iterations(self, records: Sequence[IterationRecord]) -> None:
        """Append lines to results.jsonl; a line torn by a kill is dropped when it is read."""
        if not records:
            return
        text = "".join(dump(record, indent=None) for record in records)
        with self.owned(), open_to_append(self.results_path) as file:
            file.write(text.encode())

    def read_iterations(self) -> list[IterationRecord]:
        """Every line of results.jsonl that can be read, in order, with a warning for others; empty without a file."""
        found = read_results(self.results_path)
        for bad in found.bad:
            _LOG.warning("%s is read without a line that is damaged: %s", self.results_path, bad)
        return found.records

    def keep_iterations(self, records: Sequence[IterationRecord]) -> None:
        """Replace results.jsonl by these lines: those up to the checkpoint a trial goes on from."""
        text = "".join(dump(record, indent=None) for record in records)
        with self.owned():
            write_atomic(self.results_path, text)

    def checkpoints(self) -> list[CheckpointRecord]:
        """The complete checkpoints, oldest first (those being written have no final name yet).

        Raises:
            CheckpointError: A manifest is damaged, or of another checkpoint than lies there.
        """
        return [self.checkpoint(iteration) for iteration in self.checkpoint_iterations()]

    def checkpoint_iterations(self) -> list[int]:
        """Those that have a checkpoint, damaged or not, in order."""
        numbers = (checkpoint_iteration(path.name) for path in parts_of(self.checkpoints_folder))
        return sorted(number for number in numbers if number is not None)

    def checkpoint(self, iteration: int) -> CheckpointRecord:
        """The manifest of an iteration's checkpoint.

        Raises:
            NotFoundError: There is none.
            CheckpointError: It is damaged, or of another checkpoint.
        """
        folder = self.checkpoint_folder(iteration)
        record = read_manifest(folder)
        if (record.trial_id, record.iteration) != (self.trial_id, iteration):
            raise CheckpointError(
                f"The manifest of checkpoint {folder} is of trial {record.trial_id}, iteration {record.iteration}.",
                "Delete this folder; the trial goes on from its other checkpoints.",
            )
        return record

    def write_checkpoint(self, record: CheckpointRecord, write: Callable[[Path], None], engine: str = "") -> None:
        """Write a checkpoint folder whole: to a hidden name, hashed, synced, then renamed.

        Args:
            record: Its scores and iteration.
            write: Fills the folder it is given.
            engine: Name of the engine that can go on from it; empty: the manifest names none.

        Raises:
            CheckpointError: Its place is a symbolic link.
        """
        target = self.checkpoint_folder(record.iteration)
        temporary = target.with_name(f".{target.name}.{os.getpid()}-{secrets.token_hex(4)}")
        with self.owned():
            make_folder(temporary)
        try:
            write(temporary)
            write_manifest(temporary, record, engine)
            with self.owned():
                # There is one if the trial went on from an earlier checkpoint and writes this iteration anew.
                remove_folder(target)
                temporary.replace(target)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise

    def delete_checkpoint(self, record: CheckpointRecord) -> None:
        """Remove a checkpoint: first from sight, then from disk.

        Raises:
            CheckpointError: Its place is a symbolic link.
        """
        folder = self.checkpoint_folder(record.iteration)
        hidden = folder.with_name(f".{folder.name}.deleted")
        with self.owned():
            remove_folder(hidden)
            folder.replace(hidden)
        remove_folder(hidden)

    def remove_leftovers(self) -> None:
        """Delete half-written or half-deleted checkpoints of a process that was killed."""
        if self.checkpoints_folder.is_dir():
            for folder in self.checkpoints_folder.iterdir():
                if folder.name.startswith(".") and not folder.is_symlink():
                    remove_folder(folder)

    def log_tail(self, num_lines: int = 15) -> str:
        """See `logs.log_tail`: of the trial's last process."""
        return log_tail(self.log_path, f"trial {self.trial_id}", num_lines)


class SweepStore:
    """One sweep's folder."""

    def __init__(self, folder: Path) -> None:
        # Ray takes only absolute paths for storage ("URI has empty scheme" otherwise).
        self.folder = absolute(folder)
        self.record_path = self.folder / "sweep.json"
        self._stop_path = self.folder / ".stop"
        self._lock_path = self.folder / ".lock"
        self._driver_lock_path = self.folder / ".driver-lock"
        self._made: list[Path] = []

    @property
    def best_folder(self) -> Path:
        """The winner's policy, its evaluation and films; without links."""
        return refuse_links_in(self.folder / "best")

    @property
    def report_folder(self) -> Path:
        """The report."""
        return within(self.folder, "report")

    @property
    def tune_folder(self) -> Path:
        """Ray Tune's own state."""
        return within(self.folder, "tune")

    @property
    def driver_log(self) -> Path:
        """What Ray and RLlib print in the process that drives the sweep."""
        return within(self.folder, "driver.log")

    @property
    def name(self) -> str:
        """The sweep's name: its folder's."""
        return self.folder.name

    def exists(self) -> bool:
        """Whether a sweep lies here; one that this user may not look at does, and is refused when it is read."""
        try:
            return self.record_path.is_file()
        except PermissionError:
            return True

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
        refuse_link(self.record_path)
        return read_record(self.record_path, SweepRecord, "sweep")

    def write_record(self, record: SweepRecord) -> None:
        """Replace sweep.json."""
        write_atomic(self.record_path, dump(record))

    def trial(self, trial_id: str) -> TrialStore:
        """The folder of one trial.

        Raises:
            NotFoundError: No trial is called so.
        """
        return TrialStore(self.folder, trial_id)

    def checkpoint_folder(self, record: CheckpointRecord) -> Path:
        """Where a checkpoint lies.

        Raises:
            CheckpointError: A symbolic link is in the way.
        """
        return self.trial(record.trial_id).checkpoint_folder(record.iteration)

    def read_trials(self) -> list[TrialRecord]:
        """Every trial's record, by index."""
        folders = parts_of(within(self.folder, "trials"))
        stores = [self.trial(path.name) for path in folders if is_trial_id(path.name)]
        records = [store.read_record() for store in stores if store.record_path.is_file()]
        return sorted(records, key=lambda record: record.index)

    def read_best(self) -> BestRecord:
        """best/evaluation.json.

        Raises:
            NotFoundError: No best policy has been chosen yet.
        """
        path = within(self.best_folder, "evaluation.json")
        if not path.is_file():
            raise NotFoundError(
                f"Sweep {self.name} has no best policy yet.", f"Choose it with `tune-jobs best {self.name}`."
            )
        return read_record(path, BestRecord, "best record", is_sealed=True)

    def write_best(self, record: BestRecord) -> None:
        """Replace best/evaluation.json."""
        write_atomic(self.best_folder / "evaluation.json", dump_sealed(record))

    def request_stop(self) -> None:
        """Ask the process that drives this sweep to stop."""
        write_atomic(self._stop_path, "stop\n")

    def stop_requested(self) -> bool:
        """Whether somebody asked."""
        return self._stop_path.exists()

    def clear_stop_request(self) -> None:
        """Forget the request."""
        remove_file(self._stop_path)

    def is_driven(self) -> bool:
        """Whether a process drives this sweep now (on this machine, or on one that shares locks with it)."""
        return is_held(self._lock_path) or is_held(self._driver_lock_path)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the sweep's lock; the system frees it when the process ends, however it ends.

        Raises:
            CannotRunError: Another process holds it, or runs the sweep on a cluster.
        """
        watch = f"Watch it with `tune-jobs status {self.name}`, or end it with `tune-jobs stop {self.name}`."
        with held(self._lock_path, f"Sweep {self.name} is being run by another process.", watch):
            if is_held(self._driver_lock_path):
                raise CannotRunError(*self._still_driven)
            yield

    @contextlib.contextmanager
    def driver_lock(self) -> Iterator[None]:
        """Hold the lock of the process on a cluster that drives the sweep for a client, which holds the sweep's lock.

        Raises:
            CannotRunError: Such a process still runs.
        """
        with held(self._driver_lock_path, *self._still_driven):
            yield

    @property
    def _still_driven(self) -> tuple[str, str]:
        return (
            f"Sweep {self.name} is still being run on a cluster, for a process that is gone.",
            "Try again in a minute: the cluster is ending it.",
        )


def name_taken(folder: Path) -> SpecError:
    """The error for a new sweep whose folder is there already."""
    go_on = f"go on with it: `tune-jobs resume {folder.name}`"
    other = go_on if SweepStore(folder).exists() else "remove that folder: it has no sweep.json"
    hint = f"Choose another name with --name, or {other}."
    return SpecError(f"A sweep {folder.name!r} is already in {folder.parent}.", hint)


def list_sweep_stores(storage: Path) -> list[SweepStore]:
    """The sweeps in a storage folder, by name; empty if there is no such folder.

    Raises:
        CheckpointError: It cannot be looked into.
    """
    return [store for store in map(SweepStore, sorted(parts_of(storage))) if store.exists()]

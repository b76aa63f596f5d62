"""The folder of one trial: its record, results, checkpoints, log and tally.

See `contract.Trial` for who may write what and when. `copies` has the checkpoints of other trials that it continues
from, `recovery` handles damaged files.
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import shutil
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path

from analysis.records import CheckpointRecord, IterationRecord, TrialRecord
from policies.errors import CannotRunError, CheckpointError
from policies.files import open_to_append, sync, write_atomic
from tune_jobs.store import names
from tune_jobs.store.logs import log_tail
from tune_jobs.store.manifests import files_of, read_manifest, sync_folder, verify_checkpoint, write_manifest
from tune_jobs.store.ownership import OwnedFolder
from tune_jobs.store.places import (
    check_trial_id,
    checkpoint_iteration,
    make_folder,
    names_in,
    parts_of,
    remove_folder,
    within,
)
from tune_jobs.store.presence import is_link, is_there
from tune_jobs.store.record_files import dump, read_record
from tune_jobs.store.results_file import ResultsFile, Scored, read_results, read_scores
from tune_jobs.store.results_tail import NewPoints, ResultsMark, read_new_points

_LOG = logging.getLogger(__name__)


class TrialStore(OwnedFolder):
    """One trial's folder; implements `Trial`."""

    def __init__(self, sweep_folder: Path, trial_id: str) -> None:
        self.sweep_folder = sweep_folder
        self.trial_id = check_trial_id(trial_id)

    # Checked anew each time, because the folder may be replaced by a link at any time.

    @property
    def folder(self) -> Path:
        """The trial's folder."""
        return within(self.sweep_folder, names.TRIALS_FOLDER, self.trial_id)

    @property
    def record_path(self) -> Path:
        """The path of trial.json."""
        return within(self.folder, names.TRIAL_RECORD)

    @property
    def results_path(self) -> Path:
        """The path of results.jsonl."""
        return within(self.folder, names.RESULTS)

    @property
    def log_path(self) -> Path:
        """The path of log.txt."""
        return within(self.folder, names.TRIAL_LOG)

    @property
    def tally_path(self) -> Path:
        """The path of the tally, which says how far a trial is whose process runs or was killed."""
        return within(self.folder, names.TALLY)

    @property
    def checkpoints_folder(self) -> Path:
        """The folder of its checkpoints."""
        return within(self.folder, names.CHECKPOINTS_FOLDER)

    def checkpoint_folder(self, iteration: int) -> Path:
        """Return the folder of an iteration's checkpoint, which need not exist."""
        return within(self.checkpoints_folder, f"{iteration:06d}")

    def read_record(self) -> TrialRecord:
        """Read trial.json.

        Raises:
            NotFoundError: There is no such file.
            CheckpointError: It is damaged, of a newer format, or another trial's.
        """
        record = read_record(self.record_path, TrialRecord, "trial record")
        if record.trial_id != self.trial_id:
            raise CheckpointError(
                f"{self.record_path} is of trial {record.trial_id}, but it is in the folder of {self.trial_id}.",
                "Restore the file from a backup.",
            )
        return record

    def settle(self) -> None:
        """Wait until the results are on disk, too: all else is there when it has been written."""
        if is_there(self.results_path):
            try:
                sync(self.results_path)
            except OSError as error:
                # NFS and quotas tell of a full disk as late as here.
                raise CannotRunError(
                    f"{self.results_path} cannot be written: {error.strerror}.", "Free space on its disk."
                ) from error

    def write_record(self, record: TrialRecord, *, soon: bool = False) -> None:  # noqa: ARG002 (never later here)
        """Replace trial.json."""
        write_atomic(self.record_path, dump(record))

    def append_iterations(self, records: Sequence[IterationRecord]) -> None:
        """Append lines to results.jsonl; a line that a kill has cut off is dropped when it is read."""
        if not records:
            return
        text = "".join(dump(record, indent=None) for record in records)
        with self.owned(), open_to_append(self.results_path) as file:
            file.write(text.encode())

    def read_results(self, after: int = -1) -> ResultsFile:
        """Read results.jsonl; see `Trial.read_results`."""
        return read_results(self.results_path, after)

    def read_iterations(self, after: int = -1) -> list[IterationRecord]:
        """Read the lines of results.jsonl that can be read, with a warning for others; empty without a file."""
        found = self.read_results(after)
        for bad in found.bad:
            _LOG.warning("%s is read without a line that is damaged: %s", self.results_path, bad)
        return found.records

    def read_new_points(self, since: ResultsMark) -> NewPoints:
        """Read the lines of results.jsonl behind a mark; see `Trial.read_new_points`."""
        return read_new_points(self.results_path, since)

    def scores_of(self, iterations: Collection[int]) -> dict[int, list[Scored]]:
        """Return the scores of some iterations in results.jsonl; see `Trial.scores_of`."""
        return read_scores(self.results_path, iterations)

    def keep_damaged_results(self, lines: Sequence[bytes]) -> None:
        """Append lines to results.damaged."""
        with self.owned(), open_to_append(within(self.folder, names.DAMAGED_RESULTS)) as file:
            file.write(b"".join(line + b"\n" for line in lines))

    def set_aside_results(self) -> str:
        """Move away a results.jsonl that can't be read; see `Trial.set_aside_results`."""
        return self.set_aside(self.results_path)

    def has_results(self) -> bool:
        """Whether there is a results.jsonl, with lines or without."""
        return is_there(self.results_path)

    def keep_iterations(self, records: Sequence[IterationRecord]) -> None:
        """Replace results.jsonl by the lines up to the checkpoint that the trial continues from."""
        text = "".join(dump(record, indent=None) for record in records)
        with self.owned():
            write_atomic(self.results_path, text)

    def checkpoints(self) -> list[CheckpointRecord]:
        """Read the complete checkpoints, oldest first (those being written have no final name yet).

        Raises:
            CheckpointError: A manifest is damaged, or belongs to another checkpoint.
        """
        return [self.checkpoint(iteration) for iteration in self.checkpoint_iterations()]

    def checkpoint_iterations(self) -> list[int]:
        """Return the iterations that have a checkpoint, damaged or not, in order."""
        numbers = (checkpoint_iteration(path.name) for path in parts_of(self.checkpoints_folder))
        return sorted(number for number in numbers if number is not None)

    def checkpoint(self, iteration: int) -> CheckpointRecord:
        """Read the manifest of an iteration's checkpoint.

        Raises:
            NotFoundError: There is no such checkpoint.
            CheckpointError: It is damaged, or belongs to another checkpoint.
        """
        folder = self.checkpoint_folder(iteration)
        record = read_manifest(folder)
        if (record.trial_id, record.iteration) != (self.trial_id, iteration):
            raise CheckpointError(
                f"The manifest of checkpoint {folder} is of trial {record.trial_id}, iteration {record.iteration}.",
                "Delete this folder; the trial continues from its other checkpoints.",
            )
        return record

    @contextlib.contextmanager
    def reading_checkpoint(self, iteration: int) -> Iterator[Path]:
        """Yield the checkpoint's folder."""
        yield self.checkpoint_folder(iteration)

    def verify_checkpoint(self, iteration: int) -> CheckpointRecord:
        """Check every file of a checkpoint; see `Trial.verify_checkpoint`."""
        return verify_checkpoint(self.checkpoint_folder(iteration))

    def checkpoint_files(self, iteration: int) -> dict[str, Path]:
        """Check a checkpoint and return its files; see `Trial.checkpoint_files`."""
        self.verify_checkpoint(iteration)
        return files_of(self.checkpoint_folder(iteration))

    def write_checkpoint(self, record: CheckpointRecord, write: Callable[[Path], None], engine: str = "") -> None:
        """Write a checkpoint folder atomically: under a hidden name, hashed, synced, then renamed.

        Args:
            record: Its scores and iteration.
            write: Fills the folder that it is given.
            engine: Name of the engine that can continue from it; empty: the manifest names none.

        Raises:
            CheckpointError: Its path is a symbolic link.
        """
        target = self.checkpoint_folder(record.iteration)
        temporary = target.with_name(f".{target.name}.{os.getpid()}-{secrets.token_hex(4)}")
        with self.owned():
            make_folder(temporary)
        try:
            write(temporary)
            # Results come first, as a trial that goes on from this checkpoint counts on them.
            self.settle()
            write_manifest(temporary, record, engine)
            with self.owned():
                # It exists if the trial continued from an earlier checkpoint and writes this iteration anew.
                remove_folder(target)
                temporary.replace(target)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        sync(self.checkpoints_folder)  # as in `atomic_path`

    def delete_checkpoint(self, record: CheckpointRecord) -> None:
        """Remove a checkpoint: it is hidden first, then deleted.

        Raises:
            CheckpointError: Its path is a symbolic link.
        """
        folder = self.checkpoint_folder(record.iteration)
        hidden = folder.with_name(f".{folder.name}.deleted")
        with self.owned():
            remove_folder(hidden)
            folder.replace(hidden)
        remove_folder(hidden)

    def copied_checkpoint(self, iteration: int) -> Path:
        """Return the folder of the copy that was made at an iteration, which need not exist."""
        return within(self._copies_folder, f"{iteration:06d}")

    @property
    def _copies_folder(self) -> Path:
        return within(self.folder, names.COPIES_FOLDER)

    def copy_checkpoint(self, folder: Path, iteration: int) -> CheckpointRecord:
        """Copy another trial's checkpoint, and verify the copy; see `Trial.copy_checkpoint`."""
        final = self.copied_checkpoint(iteration)
        temporary = final.with_name(f".{final.name}")
        try:
            remove_folder(temporary)
            # Links are copied as links, which `verify_checkpoint` refuses, so that their targets are not copied.
            shutil.copytree(folder, temporary, symlinks=True)
            record = verify_checkpoint(temporary)
            sync_folder(temporary)
            remove_folder(final)
            temporary.replace(final)
        except BaseException:
            remove_folder(temporary)
            raise
        # With its name, as a record that says that the trial goes on from it comes next.
        sync(self._copies_folder)
        return record

    def remove_copies(self, keep: Collection[int] = ()) -> None:
        """Delete the copies of other iterations than these; see `Trial.remove_copies`."""
        kept = {self.copied_checkpoint(iteration).name for iteration in keep}
        with self.owned():
            for path in parts_of(self._copies_folder):
                if path.name not in kept:
                    remove_folder(path)
            with contextlib.suppress(OSError):
                self._copies_folder.rmdir()

    def set_aside(self, path: Path, prefix: str = "") -> str:
        """Move a checkpoint or a copy to damaged/; see `Trial.set_aside`."""
        target = within(self.folder, names.DAMAGED_FOLDER, f"{prefix}{path.name}")
        number = 1
        while is_there(target):
            number += 1
            target = target.with_name(f"{prefix}{path.name}-{number}")
        with self.owned():
            target.parent.mkdir(exist_ok=True)
            if is_there(path):
                path.replace(target)
        return f"{names.DAMAGED_FOLDER}/{target.name}"

    def latest_damaged(self) -> int:
        """Return the latest iteration of the checkpoints that were set aside; 0 if there is none."""
        found = [name.partition("-")[0] for name in names_in(self.folder / names.DAMAGED_FOLDER)]
        return max((int(name) for name in found if name.isdecimal()), default=0)

    def append_events(self, name: str, data: bytes) -> None:
        """Append to an event file in tensorboard/."""
        with open_to_append(within(self.folder, names.EVENTS_FOLDER, name)) as file:
            file.write(data)

    def remove_leftovers(self) -> None:
        """Delete checkpoints that a killed process had written or deleted only in part."""
        for folder in parts_of(self.checkpoints_folder):
            if folder.name.startswith(".") and not is_link(folder):
                remove_folder(folder)

    def forget_tally(self) -> None:
        """Delete the tally, because its numbers are in the record, or the trial is over.

        Raises:
            OwnershipLostError: This process had taken the trial, and another one has it now.
        """
        # A folder of this name is not a tally, and is never read.
        with self.owned(), contextlib.suppress(OSError):
            self.tally_path.unlink(missing_ok=True)

    def write_log(self, text: str) -> None:
        """Append a line to the trial's log, wherever the output of its process goes."""
        line = f"{time.strftime('%Y-%m-%d %H:%M:%S')} process {os.getpid()}: {text}\n"
        with open_to_append(self.log_path) as file:
            # The message of an env's error may contain what UTF-8 cannot encode.
            file.write(line.encode(errors="backslashreplace"))

    def newest_log(self) -> Path:
        """Return the log."""
        return self.log_path

    def log_tail(self, num_lines: int = 15) -> str:
        """Return the lines that say how the trial's last process ended."""
        return log_tail(self.log_path, f"trial {self.trial_id}", num_lines)

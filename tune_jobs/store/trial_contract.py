"""The contract of a store for one trial; the rules for all of it are in `contract`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

from analysis.records import CheckpointRecord, IterationRecord, TrialRecord
from tune_jobs.store.results_file import ResultsFile, Scored
from tune_jobs.store.results_tail import NewPoints, ResultsMark


class Ownership(Protocol):
    """The ownership of a sweep's run, a pack or a trial, taken here or received by its token; see `contract`."""

    @property
    def token(self) -> str:
        """The text by which another process works for the same owner; it is valid only for this epoch."""
        ...

    def held(self) -> AbstractContextManager[None]:
        """Keep other processes from becoming the owner in the block; it must be short, as they wait, and not nested.

        Raises:
            OwnershipLostError: Another process has become the owner.
            CannotRunError: It cannot be locked.
        """
        ...

    def is_current(self) -> bool:
        """Whether no other process has become the owner, as far as can be seen without waiting.

        Raises:
            OSError: It cannot be read just now.
        """
        ...

    def check(self) -> None:
        """Raise an error if another process has become the owner.

        Raises:
            OwnershipLostError: Another process has.
        """
        ...

    def release(self) -> None:
        """Close open files; the ownership stays, and may be used again."""
        ...


class Trial(Protocol):
    """One trial. The driver writes its record; the process that took the trial last writes the rest."""

    @property
    def trial_id(self) -> str:
        """The trial's id: `t0000` and so on."""
        ...

    # -- who writes

    def take(self, under: Ownership | None = None) -> None:
        """Become the process that writes here; the process before has lost the trial.

        Args:
            under: The ownership of the run or the pack that this is done for; it has to be current.

        Raises:
            OwnershipLostError: Another process has taken `under`; the trial keeps its owner.
            CannotRunError: The trial cannot be written or locked.
        """
        ...

    def owned(self) -> AbstractContextManager[None]:
        """Return the context manager for writes other than these calls; it does nothing without a `take` before.

        Raises:
            OwnershipLostError: Another process has taken it.
        """
        ...

    def is_lost(self) -> bool:
        """Whether this process has taken the trial, and another one has taken it since."""
        ...

    def settle(self) -> None:
        """Wait until what this process has written here is kept for all, whatever becomes of this machine.

        A store that is far away takes checkpoints and results in the background, and a disk takes results some seconds
        after they were written. A process calls this before it says of a trial that it has ended, or is paused.

        Raises:
            OwnershipLostError: Another process has taken the trial; something was not kept.
            CannotRunError: Something cannot be kept.
        """
        ...

    # -- its record

    def read_record(self) -> TrialRecord:
        """Read the record that the driver wrote last.

        Raises:
            NotFoundError: There is no such trial.
            CheckpointError: It is damaged, of a newer format, or another trial's.
        """
        ...

    def write_record(self, record: TrialRecord, *, soon: bool = False) -> None:
        """Replace the record, atomically.

        Args:
            record: The record.
            soon: Whether it may be kept a little later; `Sweep.settle` waits for it.

        Raises:
            CannotRunError: It cannot be written.
        """
        ...

    # -- its results: one record per iteration, appended

    def append_iterations(self, records: Sequence[IterationRecord]) -> None:
        """Append results.

        Raises:
            OwnershipLostError: Another process has taken the trial; nothing was added.
        """
        ...

    def read_results(self, after: int = -1) -> ResultsFile:
        """Read the results: the lines that can be read, and those that can't; empty if there are none.

        Args:
            after: Only results of later iterations are read; damage in the others may not be noticed.

        Raises:
            CheckpointError: The results exist but cannot be read at all.
        """
        ...

    def read_iterations(self, after: int = -1) -> list[IterationRecord]:
        """Read the results that can be read, with rising iterations; a warning names what is left out.

        Args:
            after: As for `read_results`.

        Raises:
            CheckpointError: In the same cases as `read_results`.
        """
        ...

    def read_new_points(self, since: ResultsMark) -> NewPoints:
        """Read the results that were appended since a mark, as points of learning curves, and return the next mark.

        A line that is being appended is no part of them until it is whole.

        Raises:
            CheckpointError: In the same cases as `read_results`.
        """
        ...

    def scores_of(self, iterations: Collection[int]) -> Mapping[int, Sequence[Scored]]:
        """Return the scores of some iterations in the results, one for each line that can be read.

        Raises:
            CheckpointError: In the same cases as `read_results`.
        """
        ...

    def has_results(self) -> bool:
        """Whether any results have been written, readable or not."""
        ...

    def keep_iterations(self, records: Sequence[IterationRecord]) -> None:
        """Replace all results, atomically, by those up to the checkpoint that the trial continues from.

        Raises:
            OwnershipLostError: Another process has taken the trial; nothing was changed.
        """
        ...

    # -- its checkpoints: folders, committed whole, with a sealed manifest

    def checkpoint_iterations(self) -> list[int]:
        """Return the iterations that have a whole or damaged checkpoint, in order; not those written or deleted now."""
        ...

    def checkpoint(self, iteration: int) -> CheckpointRecord:
        """Read a checkpoint's manifest; its files are not checked.

        Raises:
            NotFoundError: There is no such checkpoint.
            CheckpointError: The manifest is damaged, was changed, or is another checkpoint's.
        """
        ...

    def checkpoints(self) -> list[CheckpointRecord]:
        """Read the manifests of all checkpoints, oldest first.

        Raises:
            CheckpointError: In the same cases as `checkpoint`.
        """
        ...

    def checkpoint_folder(self, iteration: int) -> Path:
        """Return a local folder with a checkpoint's files, to read only; it is removed with the checkpoint.

        If there is no such checkpoint, the folder does not exist. Of an object store, it is a copy, which is there as
        long as this trial or its sweep is kept.

        Raises:
            CheckpointError: A symbolic link is in the way.
        """
        ...

    def reading_checkpoint(self, iteration: int) -> AbstractContextManager[Path]:
        """Yield a local folder as `checkpoint_folder` returns it, which is there in the block.

        What a store far away fetched for it is removed after it: for who reads many checkpoints one after the other.

        Raises:
            CheckpointError: A symbolic link is in the way.
        """
        ...

    def verify_checkpoint(self, iteration: int) -> CheckpointRecord:
        """Check every file against the manifest, before any file is read.

        Raises:
            NotFoundError: There is no such checkpoint.
            CheckpointError: A file is missing, was changed, or is not named in the manifest.
        """
        ...

    def checkpoint_files(self, iteration: int) -> Mapping[str, Path]:
        """Check every file of a checkpoint, and return them by their names, the manifest too, to read only.

        Raises:
            NotFoundError: As `verify_checkpoint`; a CheckpointError likewise.
        """
        ...

    def write_checkpoint(self, record: CheckpointRecord, write: Callable[[Path], None], engine: str = "") -> None:
        """Write a checkpoint, which appears when it is whole and on disk; one of the same iteration is replaced.

        Args:
            record: Its iteration and scores, which are written to its manifest.
            write: Fills the empty local folder that it is given. If it raises an error, nothing is written, and the
                error is raised here.
            engine: Name of the engine that can continue from it, for its manifest; empty: not known.

        Raises:
            OwnershipLostError: Another process has taken the trial; no checkpoint of it was changed.
            CannotRunError: It cannot be written.
        """
        ...

    def delete_checkpoint(self, record: CheckpointRecord) -> None:
        """Remove a checkpoint; a reader sees the whole checkpoint or nothing.

        Raises:
            OwnershipLostError: Another process has taken the trial; the checkpoint was not removed.
        """
        ...

    # -- copies of other trials' checkpoints that it continues from, by its own iteration at that time

    def copy_checkpoint(self, folder: Path, iteration: int) -> CheckpointRecord:
        """Copy a whole checkpoint and verify the copy; the driver does this, between two iterations of the trial.

        Args:
            folder: The result of the other trial's `checkpoint_folder`.
            iteration: The iterations that this trial has done; a copy of the same iteration is replaced.

        Raises:
            OSError: A part of it is missing, because its trial has deleted it; nothing was copied.
            NotFoundError: It is missing or damaged.
        """
        ...

    def copied_checkpoint(self, iteration: int) -> Path:
        """Return a local folder with a copy, to read only; it does not exist if there is no copy."""
        ...

    def remove_copies(self, keep: Collection[int] = ()) -> None:
        """Delete all copies except those of some iterations.

        Where checkpoints are kept a moment later, a process that has taken the trial deletes its copies after them, and
        only those made before the latest one: until then the trial goes on from a copy.

        Raises:
            OwnershipLostError: This process had taken the trial, and another one has it now.
        """
        ...

    # -- what was damaged: set aside, never deleted

    def keep_damaged_results(self, lines: Sequence[bytes]) -> None:
        """Keep lines that can't be read; they stay in the results until `keep_iterations`.

        Raises:
            OwnershipLostError: Another process has taken the trial.
        """
        ...

    def set_aside_results(self) -> str:
        """Move away results that can't be read at all, and return where they are now, for a message.

        Raises:
            OwnershipLostError: Another process has taken the trial; nothing was moved.
        """
        ...

    def set_aside(self, path: Path, prefix: str = "") -> str:
        """Move away a damaged checkpoint or copy, so that it is not used; all of several for one iteration are kept.

        Args:
            path: A result of `checkpoint_folder` or `copied_checkpoint`.
            prefix: Put before its name.

        Returns:
            Where it is now, for a message.

        Raises:
            OwnershipLostError: Another process has taken the trial; nothing was moved.
        """
        ...

    def latest_damaged(self) -> int:
        """Return the latest iteration of a checkpoint that was set aside; 0 if there is none."""
        ...

    def remove_leftovers(self) -> None:
        """Remove what a killed process had written or deleted only in part; the caller has to have taken the trial."""
        ...

    # -- its curves, log and tally

    def append_events(self, name: str, data: bytes) -> None:
        """Append to one of the trial's event files, which TensorBoard reads; the driver does this.

        Raises:
            CannotRunError: It cannot be written.
        """
        ...

    @property
    def log_path(self) -> Path:
        """A local file that the trial's process appends its output to; readers use `newest_log` and `log_tail`."""
        ...

    def newest_log(self) -> Path:
        """Return a local file with the log as it is known anywhere, to read only; without a log there is none.

        Of an object store, it may be a copy, which is there as long as this trial or its sweep is kept.
        """
        ...

    def write_log(self, text: str) -> None:
        """Append a line to the log, with the time and this process."""
        ...

    def log_tail(self, num_lines: int = 15) -> str:
        """Return the lines that say how the trial's last process ended; empty without a log."""
        ...

    @property
    def tally_path(self) -> Path:
        """A local file that says how far the trial is while a process trains it, or after that process was killed."""
        ...

    def forget_tally(self) -> None:
        """Delete the tally, because its numbers are in the record, or the trial is over.

        Raises:
            OwnershipLostError: This process had taken the trial, and another one has it now.
        """
        ...

"""What a store promises of one trial and of one pack; what holds for all of it is in `contract`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from analysis.records import CheckpointRecord, IterationRecord, TrialRecord
from tune_jobs.store.results_file import ResultsFile, Scored


@dataclass(frozen=True)
class Assignment:
    """Whom a pack is to train."""

    trial_ids: tuple[str, ...] = ()
    """Its members, in the order in which they came; whom it trains and who is not named is to be ended."""
    num_failures: Mapping[str, int] = field(default_factory=dict)
    """How often a member has failed by itself in this run; those that have not are not named."""


class Ownership(Protocol):
    """That something was taken up, by this process or the one that passed its token on; see `contract`."""

    @property
    def token(self) -> str:
        """What another process is told so that it works for the same owner; text, of this epoch alone."""
        ...

    def held(self) -> AbstractContextManager[None]:
        """Write in the block: nobody takes it up meanwhile. Not to be nested; others wait, so it is to be short.

        Raises:
            OwnershipLostError: Another process has taken it up.
            CannotRunError: It cannot be locked.
        """
        ...

    def is_current(self) -> bool:
        """Whether nobody else has taken it up, as far as can be seen without waiting.

        Raises:
            OSError: It cannot be read just now.
        """
        ...

    def check(self) -> None:
        """Raise if another process has taken it up.

        Raises:
            OwnershipLostError: It has.
        """
        ...

    def release(self) -> None:
        """Free what it has open; it still owns what it owned, and may be used again."""
        ...


class Trial(Protocol):
    """One trial. Its record is the driver's; the rest belongs to the process that took the trial last."""

    @property
    def trial_id(self) -> str:
        """`t0000` and so on."""
        ...

    # -- who writes

    def take(self, under: Ownership | None = None) -> None:
        """Become the process that writes here; whoever was it has lost it.

        Args:
            under: The run or the pack that this is done for: only as long as that is owned still.

        Raises:
            OwnershipLostError: `under` is another's by now; the trial stays with whom it was.
            CannotRunError: The trial cannot be written or locked.
        """
        ...

    def owned(self) -> AbstractContextManager[None]:
        """What is entered around a write that is none of the calls here; nothing to who has not taken the trial.

        Raises:
            OwnershipLostError: Another process has taken it.
        """
        ...

    def is_lost(self) -> bool:
        """Whether this process has taken the trial, and another one after it."""
        ...

    # -- its record

    def read_record(self) -> TrialRecord:
        """What the driver wrote last.

        Raises:
            NotFoundError: There is no such trial.
            CheckpointError: It is damaged, of a newer format, or another trial's.
        """
        ...

    def write_record(self, record: TrialRecord) -> None:
        """Replace the record, atomically.

        Raises:
            CannotRunError: It cannot be written.
        """
        ...

    # -- its results: one record an iteration, appended

    def append_iterations(self, records: Sequence[IterationRecord]) -> None:
        """Add results after those that are there.

        Raises:
            OwnershipLostError: Another process has taken the trial; nothing was added.
        """
        ...

    def read_results(self) -> ResultsFile:
        """What can be read of the results, and apart from that what can't; empty if there are none.

        Raises:
            CheckpointError: They are there and cannot be read at all.
        """
        ...

    def read_iterations(self) -> list[IterationRecord]:
        """The results that can be read, iterations rising; a warning names what is left out.

        Raises:
            CheckpointError: As `read_results`.
        """
        ...

    def scores_of(self, iterations: Collection[int]) -> Mapping[int, Sequence[Scored]]:
        """What the results say of some iterations, once for each line of one that can be read.

        Raises:
            CheckpointError: As `read_results`.
        """
        ...

    def has_results(self) -> bool:
        """Whether anything has been written as results, readable or not."""
        ...

    def keep_iterations(self, records: Sequence[IterationRecord]) -> None:
        """Replace all results, atomically: by those up to the checkpoint that the trial goes on from.

        Raises:
            OwnershipLostError: Another process has taken the trial; all is as it was.
        """
        ...

    # -- its checkpoints: folders, committed whole, with a sealed manifest

    def checkpoint_iterations(self) -> list[int]:
        """Those that have a checkpoint, damaged or not, in order; none that is being written or deleted."""
        ...

    def checkpoint(self, iteration: int) -> CheckpointRecord:
        """What a checkpoint's manifest says; its files are not looked at.

        Raises:
            NotFoundError: There is none.
            CheckpointError: The manifest is damaged, was changed, or is another checkpoint's.
        """
        ...

    def checkpoints(self) -> list[CheckpointRecord]:
        """The manifests of all checkpoints, oldest first.

        Raises:
            CheckpointError: As `checkpoint`.
        """
        ...

    def checkpoint_folder(self, iteration: int) -> Path:
        """A local folder with the checkpoint's files, to read only; gone when the checkpoint is deleted.

        A checkpoint that there is none of has a folder that does not exist.

        Raises:
            CheckpointError: A symbolic link is in the way.
        """
        ...

    def verify_checkpoint(self, iteration: int) -> CheckpointRecord:
        """Check every file against the manifest, before anything of it is read.

        Raises:
            NotFoundError: There is no such checkpoint.
            CheckpointError: A file is missing, was changed, or is not named in the manifest.
        """
        ...

    def write_checkpoint(self, record: CheckpointRecord, write: Callable[[Path], None], engine: str = "") -> None:
        """Write a checkpoint, and show it when it is whole and on disk; one of the same iteration is replaced.

        Args:
            record: Its iteration and scores, which its manifest gets.
            write: Fills the empty local folder it is given. If it raises, nothing was written, and the error is let
                through.
            engine: Name of the engine that can go on from it, for its manifest; empty: not known.

        Raises:
            OwnershipLostError: Another process has taken the trial; no checkpoint of it was changed.
            CannotRunError: It cannot be written.
        """
        ...

    def delete_checkpoint(self, record: CheckpointRecord) -> None:
        """Remove a checkpoint; a reader sees all of it or none.

        Raises:
            OwnershipLostError: Another process has taken the trial; the checkpoint is there.
        """
        ...

    # -- checkpoints of other trials that it goes on from, by the iteration of its own at which it took them over

    def copy_checkpoint(self, folder: Path, iteration: int) -> CheckpointRecord:
        """Copy a checkpoint whole, and verify the copy; the driver does it, between two iterations of the trial.

        Args:
            folder: As `checkpoint_folder` of the other trial gave it.
            iteration: Iterations that this trial has done; a copy of the same is replaced.

        Raises:
            OSError: Something of it is gone, as its trial has deleted it; nothing was copied.
            NotFoundError: The same, or it is damaged.
        """
        ...

    def copied_checkpoint(self, iteration: int) -> Path:
        """A local folder with a copy, to read only; one that does not exist if there is none."""
        ...

    def remove_copies(self, keep: Collection[int] = ()) -> None:
        """Delete all copies but those of some iterations.

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
        """Move what is in the place of the results and can't be read at all; returns where it is, for a message.

        Raises:
            OwnershipLostError: Another process has taken the trial; it is where it was.
        """
        ...

    def set_aside(self, path: Path, prefix: str = "") -> str:
        """Move a checkpoint or a copy to where nobody takes it for one; several of one iteration are all kept.

        Args:
            path: As `checkpoint_folder` or `copied_checkpoint` gave it.
            prefix: Put before its name.

        Returns:
            Where it is now, for a message.

        Raises:
            OwnershipLostError: Another process has taken the trial; it is where it was.
        """
        ...

    def latest_damaged(self) -> int:
        """The latest iteration of a checkpoint that was set aside; 0: there is none."""
        ...

    def remove_leftovers(self) -> None:
        """Remove what a killed process had half written or half deleted; for who has taken the trial."""
        ...

    # -- its curves, log and tally

    def append_events(self, name: str, data: bytes) -> None:
        """Append to one of the trial's event files, which TensorBoard reads; the driver does it.

        Raises:
            CannotRunError: It cannot be written.
        """
        ...

    @property
    def log_path(self) -> Path:
        """A local file that the trial's process prints to, by appending; readers use `log_tail`."""
        ...

    def write_log(self, text: str) -> None:
        """Append a line to the log, with the time and this process."""
        ...

    def log_tail(self, num_lines: int = 15) -> str:
        """The lines that say how the trial's last process ended; empty without a log."""
        ...

    @property
    def tally_path(self) -> Path:
        """A local file that says how far the trial is while a process trains it, or if that did not end by itself."""
        ...

    def forget_tally(self) -> None:
        """Delete the tally: what it says is in the record, or the trial is over.

        Raises:
            OwnershipLostError: This process had taken the trial, and another one has it now.
        """
        ...


class Pack(Protocol):
    """One pack. The driver writes whom it trains; the pack's process reads it, and prints to the log."""

    @property
    def pack_id(self) -> str:
        """`p00` and so on."""
        ...

    def take(self, under: Ownership | None = None) -> Ownership:
        """Become the process that is this pack.

        Raises:
            OwnershipLostError: `under` is another's by now.
        """
        ...

    def write(self, assignment: Assignment) -> None:
        """Replace the assignment, atomically.

        Raises:
            CannotRunError: It cannot be written.
        """
        ...

    def read(self) -> Assignment:
        """The assignment.

        Raises:
            CheckpointError: It is not there, or cannot be read.
        """
        ...

    @property
    def log_path(self) -> Path:
        """A local file that the pack's process prints to, by appending."""
        ...

    def begin_log(self) -> None:
        """Print what tells this process's output, which goes to the log, from that of earlier ones."""
        ...

    def log_tail(self, num_lines: int = 15) -> str:
        """The lines that say how the pack's last process ended; empty without a log."""
        ...

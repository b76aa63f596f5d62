"""The contract of a store of sweeps: who may write what and when, what each call raises, and what is atomic.

    Storage     where sweeps are kept, by name
      Sweep     one sweep: its record, locks, owner, requests to stop, winner and report
        Trial   one training run: its record, results, checkpoints, log and tally
        Pack    one process that trains many trials: the trials it has to train, and its log

These rules hold for all of it:

- **Who writes.** The process that holds a sweep's lock (its *driver*) writes the sweep's record, its winner and report,
  every trial's record and the packs' assignments; during a run, it writes within `held` of the run's owner.
  The process that has taken a trial writes the rest of that trial, and the process that has taken a pack appends to its
  log. Any process may ask a driver to stop, and may read at any time, without a lock.
- **What is atomic.** A record, an assignment and a checkpoint exist whole or not at all, even if their writer is killed
  or the machine loses power: a reader sees either the old one or the new one. Results and logs are appended to; a
  reader never sees half a line that a killed writer was appending.
- **When it is there.** What a call has written is kept when it returns; but results and checkpoints of a trial, and
  records that are written `soon`, may be kept a moment later, in order. `settle` waits for them.
- **Epochs.** If several processes take something one after the other, the last one owns it. Every write of a process
  that has lost it raises `OwnershipLostError` and changes nothing.
- **What is trusted.** No path is taken from a file: parts are found only by names, ids and numbers, and anything that
  cannot be an id is a `NotFoundError`. These calls read, write and delete nothing outside the sweep, nor through a
  symbolic link, which is a `CheckpointError`.
- **What calls raise.** `NotFoundError`: it does not exist. `CheckpointError`, a subclass: it exists, but it is damaged,
  has a newer format, or does not belong there; the message names it. `CannotRunError`: it cannot be written or locked,
  or another process has it.
- **Paths.** A few calls return a `Path`. It is a file or folder of this machine, for the use and the time that the call
  describes; a store that keeps files elsewhere fetches them before and uploads them afterwards. Callers do not build
  other paths of the sweep from it: the contents of a checkpoint or a report are known to the code that writes them.

The tests in `test_store_contract` check that every store keeps this contract.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

from analysis.best_records import BestRecord
from analysis.records import CheckpointRecord, SweepRecord, TrialRecord
from policies.portable.file import PortablePolicy
from tune_jobs.store.pack_contract import Assignment, Pack
from tune_jobs.store.probe import Probe
from tune_jobs.store.trial_contract import Ownership, Trial

__all__ = ["Assignment", "Ownership", "Pack", "Storage", "Sweep", "Trial"]


class Sweep(Protocol):
    """One sweep. Only its driver writes here, except for requests to stop."""

    @property
    def place(self) -> str:
        """The place of the sweep, for users, other processes and `open_sweep`: an absolute folder, or a URL.

        Callers append nothing to it, and make no `Path` of it.
        """
        ...

    @property
    def name(self) -> str:
        """The sweep's name."""
        ...

    # -- its existence

    def exists(self) -> bool:
        """Whether the sweep exists: from the first `write_record` on. One that may not be read exists too.

        Raises:
            CheckpointError: The storage gives no answer; an object store's error is a CannotRunError.
        """
        ...

    def create(self) -> None:
        """Take the name; of several processes that want it at once, one gets it.

        Raises:
            SpecError: The name is taken.
            CannotRunError: The storage cannot be written; nothing was made.
        """
        ...

    def discard(self) -> None:
        """Undo `create`, including everything that was written since."""
        ...

    def delete(self) -> None:
        """Remove the sweep, with everything in it. First its record goes: half of a sweep is none.

        Raises:
            CannotRunError: A process drives it, or it cannot be removed.
        """
        ...

    def rehearsal(self) -> AbstractContextManager[Sweep]:
        """Return a hidden sweep beside this one, which is created for the block and discarded after it.

        Raises:
            CannotRunError: The storage cannot be written.
        """
        ...

    # -- its record and its parts

    def read_record(self) -> SweepRecord:
        """Read the record that the driver wrote last.

        Raises:
            NotFoundError: There is no record.
            CheckpointError: It is damaged or of a newer format.
        """
        ...

    def record_stamp(self) -> tuple[int, ...]:
        """Return what changes whenever the record is written, without reading it; empty: there is no record."""
        ...

    def write_record(self, record: SweepRecord) -> None:
        """Replace the record, atomically.

        Raises:
            CannotRunError: It cannot be written.
        """
        ...

    def settle(self) -> None:
        """Wait until the records that were written by this object are kept for all; `write_record` does so first.

        Raises:
            OwnershipLostError: Another process runs the sweep by now.
            CannotRunError: One cannot be kept.
        """
        ...

    def trial(self, trial_id: str) -> Trial:
        """Return a trial, which need not exist yet.

        Raises:
            NotFoundError: This cannot be a trial's id.
        """
        ...

    def read_trials(self) -> list[TrialRecord]:
        """Read the records of all trials that have one, by index.

        Raises:
            CheckpointError: One is damaged, of a newer format, or another trial's.
        """
        ...

    def trial_stamps(self) -> Mapping[str, tuple[int, ...]]:
        """Return what changes whenever a trial's record is written, by id, of all that have one, without reading them.

        Raises:
            CheckpointError: The trials cannot be listed.
        """
        ...

    def reading(
        self, *, results: bool = True, checkpoints: Sequence[CheckpointRecord] = ()
    ) -> AbstractContextManager[None]:
        """Read much of all trials in the block: it may be as it was at the block's beginning, or later.

        A store that is far away fetches all of it at once, instead of one after the other.

        Args:
            results: Whether results and checkpoints' manifests are read, too, and not the records alone.
            checkpoints: Checkpoints whose files are read; one that is gone is found out where it is read.

        Raises:
            CheckpointError: The trials cannot be listed.
        """
        ...

    def pack(self, pack_id: str) -> Pack:
        """Return a pack, which need not exist yet.

        Raises:
            NotFoundError: This cannot be a pack's id.
        """
        ...

    def checkpoint_folder(self, record: CheckpointRecord) -> Path:
        """Return a local folder with a checkpoint's files; see `Trial.checkpoint_folder`."""
        ...

    # -- who drives it

    def lock(self) -> AbstractContextManager[None]:
        """Be the sweep's driver in the block; the lock is freed when the process ends, however it ends.

        Raises:
            CannotRunError: Another process holds it, or drives the sweep on a cluster.
        """
        ...

    def driver_lock(self) -> AbstractContextManager[None]:
        """Drive it on a cluster, for a client that holds `lock`.

        Raises:
            CannotRunError: Such a process still runs.
        """
        ...

    def is_driven(self) -> bool:
        """Whether a process holds one of the locks; asking keeps no process from getting it.

        Raises:
            CannotRunError: This cannot be found out.
        """
        ...

    def take(self) -> Ownership:
        """Become the sweep's run: no process of an earlier run can take a trial or a pack any more.

        Raises:
            CannotRunError: The sweep cannot be written or locked.
        """
        ...

    def owner(self, token: str) -> Ownership:
        """Return the run whose token another process has passed on."""
        ...

    def remove_leftovers(self) -> None:
        """Remove incomplete files of killed processes, also those of ended trials; the caller has to hold the lock.

        Files that a process still writes, here or on another machine, stay.

        Raises:
            CheckpointError: The record of a trial is damaged.
        """
        ...

    def probing(self) -> AbstractContextManager[Probe]:
        """Find out in the block whether other machines see the same sweep; the caller has to hold the lock.

        Each machine gets the probe's `place` and calls `opening.answer` with it; nothing is left after the block.

        Raises:
            CannotRunError: The sweep cannot be written.
        """
        ...

    def request_stop(self) -> None:
        """Ask the driver to stop; any process may."""
        ...

    def stop_requested(self) -> bool:
        """Whether a stop was requested since `clear_stop_request`."""
        ...

    def clear_stop_request(self) -> None:
        """Forget the request."""
        ...

    # -- its results

    def has_best(self) -> bool:
        """Whether a winner has been written."""
        ...

    def best_stamp(self) -> tuple[int, ...]:
        """Return what changes whenever a winner is written, without reading it; empty: none has been."""
        ...

    def read_best(self) -> BestRecord:
        """Read the winner's record.

        Raises:
            NotFoundError: No winner has been chosen.
            CheckpointError: The record is damaged, was changed, or has a newer format.
        """
        ...

    def write_best(self, record: BestRecord, policy: PortablePolicy | None = None) -> None:
        """Replace the winner; the sealed record is written after the policy, so that a record always has a policy.

        Args:
            record: The winner.
            policy: Its policy; None: the present policy is kept.

        Raises:
            NotFoundError: The sweep was removed.
            CannotRunError: It cannot be written.
        """
        ...

    @property
    def best_folder(self) -> Path:
        """A local folder with the winner's portable policy, to read only.

        Raises:
            CheckpointError: There is a symbolic link in it.
        """
        ...

    @property
    def best_policy_path(self) -> Path:
        """The file in `best_folder` that a user is told to load."""
        ...

    def films(self) -> Mapping[str, Path]:
        """Return the films that exist of the present winner, to read only; none if they show another.

        They are before_mp4, after_mp4, after_gif and before_after_mp4.
        """
        ...

    def current_films(self) -> Mapping[str, Path]:
        """Return all films if they are there and show the present winner; else none."""
        ...

    def writing_films(self) -> AbstractContextManager[Mapping[str, Path]]:
        """Yield the path for each of the films of the present winner; each file has to appear whole, in the block.

        Raises:
            NotFoundError: No winner has been chosen, or the sweep was removed; then nothing of the films is left.
            CheckpointError: Its record is damaged.
            CannotRunError: It can't be written whose films they are.
        """
        ...

    def current_report(self) -> Path | None:
        """Return the report's page if it was written after the sweep's record, the winner and the films; else None."""
        ...

    def report_files(self) -> Mapping[str, Path]:
        """Return the files of the report that was written last, to read only, by their names, such as `figures/a.svg`.

        Raises:
            CheckpointError: There is a symbolic link in it.
        """
        ...

    def writing_report(self) -> AbstractContextManager[Path]:
        """Yield a local folder to write the report into, over the present one; each file has to appear whole.

        Raises:
            NotFoundError: The sweep was removed; nothing of the report is left.
            CheckpointError: There is a symbolic link in it.
        """
        ...

    # -- files of this machine and this run only

    @property
    def driver_log(self) -> Path:
        """A local file that the process that drives the sweep prints to, by appending."""
        ...

    @property
    def tune_folder(self) -> Path:
        """A local folder for Ray Tune's own state, a cache that no later run reads."""
        ...

    def clear_tune_folder(self) -> None:
        """Delete Ray Tune's state of an earlier run."""
        ...


class Storage(Protocol):
    """A place that stores sweeps by name."""

    @property
    def place(self) -> str:
        """The place of the storage, for users, other processes and `open_storage`: an absolute folder, or a URL."""
        ...

    def sweep(self, name: str) -> Sweep:
        """Return the sweep of a name, which need not exist yet.

        Raises:
            NotFoundError: This cannot be a sweep's name.
        """
        ...

    def new_sweep(self, name: str) -> Sweep:
        """Return a new sweep of a name that seems to be free; `Sweep.create` decides whether it is.

        Raises:
            NotFoundError: This cannot be a sweep's name.
            SpecError: The name is taken; the message says what to do with the present sweep or folder.
        """
        ...

    def is_taken(self, name: str) -> bool:
        """Whether `create` would find the name taken, by a sweep or by the remains of one."""
        ...

    def sweeps(self) -> Sequence[Sweep]:
        """Return the sweeps that exist, by name; none if the storage does not exist.

        Raises:
            CheckpointError: The storage cannot be read.
        """
        ...

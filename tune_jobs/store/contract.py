"""What a store of sweeps promises: who may write what and when, what each call raises, and what is atomic.

    Storage     where sweeps are kept, by name
      Sweep     one sweep: its record, locks, owner, requests to stop, winner and report
        Trial   one training run: its record, results, checkpoints, log and tally
        Pack    one process that trains many trials: whom it is to train, and its log

What holds for all of it:

- **Who writes.** The process that holds a sweep's lock (its *driver*) writes the sweep's record, its winner and report,
  every trial's record and the packs' assignments; what it writes during a run, within `held` of the run's owner. The
  process that has taken a trial writes the rest of that trial. Who has taken a pack appends to its log. Anybody may ask
  a driver to stop, and may read at any time, without a lock.
- **What is atomic.** A record, an assignment and a checkpoint are there whole or not at all, also when their writer is
  killed or the machine loses power: who reads sees the one before or the one after. Results and logs are appended to;
  of what a killed writer was appending, a reader sees no half line.
- **Epochs.** Of several processes that took something up one after the other, the last one owns it. Every write of one
  that lost it raises `OwnershipLostError` and changes nothing.
- **What is believed.** Nothing that was read names a place: parts are found by names, ids and numbers alone, and what
  cannot be an id is a `NotFoundError`. Nothing outside the sweep is read, written or deleted by any of these calls, nor
  through a symbolic link, which is a `CheckpointError`.
- **What calls raise.** `NotFoundError`: it is not there. `CheckpointError`, a kind of it: it is there, and damaged, of
  a newer format, or not the one that belongs there; the message names it. `CannotRunError`: it cannot be written or
  locked, or another process has it.
- **Folders that are handed out.** A few calls give a `Path`. It is a file or folder of this machine, good for what the
  call says and for as long as it says; what a later store keeps elsewhere, it fetches before and sends off after.
  Nobody puts another path of the sweep together from it: what a checkpoint or a report consists of is known to who
  writes it, not here.

One suite of tests, `test_store_contract`, holds every store to this.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

from analysis.records import BestRecord, CheckpointRecord, SweepRecord, TrialRecord
from policies.portable.file import PortablePolicy
from tune_jobs.store.probe import Probe
from tune_jobs.store.trial_contract import Assignment, Ownership, Pack, Trial

__all__ = ["Assignment", "Ownership", "Pack", "Storage", "Sweep", "Trial"]


class Sweep(Protocol):
    """One sweep. All that is written here is written by its driver, but for requests to stop."""

    @property
    def folder(self) -> Path:
        """Where it is: what a user and other processes are told, and `open_sweep` takes. Nothing is added to it."""
        ...

    @property
    def name(self) -> str:
        """The sweep's name."""
        ...

    # -- that there is one

    def exists(self) -> bool:
        """Whether there is a sweep: from the first `write_record` on. One that may not be looked at exists."""
        ...

    def create(self) -> None:
        """Take the name; of several that want it at once, one gets it.

        Raises:
            SpecError: It is taken.
            CannotRunError: The storage cannot be written; nothing was made.
        """
        ...

    def discard(self) -> None:
        """Undo `create`, with whatever was written since."""
        ...

    def rehearsal(self) -> AbstractContextManager[Sweep]:
        """A sweep beside this one that is created, hidden, and discarded after the block.

        Raises:
            CannotRunError: The storage cannot be written.
        """
        ...

    # -- its record and its parts

    def read_record(self) -> SweepRecord:
        """What the driver wrote last.

        Raises:
            NotFoundError: There is none.
            CheckpointError: It is damaged or of a newer format.
        """
        ...

    def write_record(self, record: SweepRecord) -> None:
        """Replace the record, atomically.

        Raises:
            CannotRunError: It cannot be written.
        """
        ...

    def trial(self, trial_id: str) -> Trial:
        """A trial, whether there is one yet or not.

        Raises:
            NotFoundError: No trial can be called so.
        """
        ...

    def read_trials(self) -> list[TrialRecord]:
        """The records of all trials that have one, by index.

        Raises:
            CheckpointError: One is damaged, of a newer format, or another trial's.
        """
        ...

    def pack(self, pack_id: str) -> Pack:
        """A pack, whether there is one yet or not.

        Raises:
            NotFoundError: No pack can be called so.
        """
        ...

    def checkpoint_folder(self, record: CheckpointRecord) -> Path:
        """See `Trial.checkpoint_folder`."""
        ...

    # -- who drives it

    def lock(self) -> AbstractContextManager[None]:
        """Be its driver in the block; freed when the process ends, however it ends.

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
        """Whether somebody holds one of the locks; nobody is kept from it by this question.

        Raises:
            CannotRunError: It cannot be seen.
        """
        ...

    def take(self) -> Ownership:
        """Become its run: no process of an earlier run can take up a trial or a pack any more.

        Raises:
            CannotRunError: The sweep cannot be written or locked.
        """
        ...

    def owner(self, token: str) -> Ownership:
        """The run whose token another process has passed on."""
        ...

    def remove_leftovers(self) -> None:
        """Remove what processes that were killed left half made, of ended trials too; for who holds its lock.

        What somebody still writes, here or on another machine, stays.

        Raises:
            CheckpointError: The record of a trial is damaged.
        """
        ...

    def probing(self) -> AbstractContextManager[Probe]:
        """Ask, in the block, whether other machines see this very sweep; for who holds its lock, before they run it.

        Each is told the probe's `place` and calls `probe.answer` with it; nothing of it is left after the block.

        Raises:
            CannotRunError: The sweep cannot be written.
        """
        ...

    def request_stop(self) -> None:
        """Ask the driver to stop; anybody may."""
        ...

    def stop_requested(self) -> bool:
        """Whether somebody asked since `clear_stop_request`."""
        ...

    def clear_stop_request(self) -> None:
        """Forget the request."""
        ...

    # -- what comes of it

    def has_best(self) -> bool:
        """Whether a winner has been written."""
        ...

    def read_best(self) -> BestRecord:
        """The winner.

        Raises:
            NotFoundError: None has been chosen.
            CheckpointError: What was written is damaged, was changed, or is of a newer format.
        """
        ...

    def write_best(self, record: BestRecord, policy: PortablePolicy | None = None) -> None:
        """Replace the winner; the record, which is sealed, comes after the policy, so who sees it finds a policy.

        Args:
            record: The winner.
            policy: Its policy; None: the one that is there.

        Raises:
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
        """The films that there are, of before_mp4, after_mp4, after_gif and before_after_mp4, to read only."""
        ...

    def writing_films(self) -> AbstractContextManager[Mapping[str, Path]]:
        """Where to write each of the films in the block; each file is to appear whole."""
        ...

    def writing_report(self) -> AbstractContextManager[Path]:
        """A local folder to write the report into in the block, over the one that is there; each file appears whole.

        Raises:
            CheckpointError: There is a symbolic link in it.
        """
        ...

    # -- what is of this machine and this run alone

    @property
    def driver_log(self) -> Path:
        """A local file that the process that drives the sweep prints to, by appending."""
        ...

    @property
    def tune_folder(self) -> Path:
        """A local folder for Ray Tune's own state: a cache, which nobody reads in a later run."""
        ...

    def clear_tune_folder(self) -> None:
        """Delete Ray Tune's state of an earlier run."""
        ...


class Storage(Protocol):
    """Where sweeps are kept."""

    def sweep(self, name: str) -> Sweep:
        """The sweep of a name, whether there is one yet or not.

        Raises:
            NotFoundError: No sweep can be called so.
        """
        ...

    def new_sweep(self, name: str) -> Sweep:
        """The sweep of a name that is likely free; `Sweep.create` decides.

        Raises:
            NotFoundError: No sweep can be called so.
            SpecError: It is taken; the message says what to do with what is there.
        """
        ...

    def is_taken(self, name: str) -> bool:
        """Whether `create` would find the name taken, by a sweep or by what a killed process left of one."""
        ...

    def sweeps(self) -> Sequence[Sweep]:
        """Those that exist, by name; none where there is no such storage.

        Raises:
            CheckpointError: It cannot be looked into.
        """
        ...

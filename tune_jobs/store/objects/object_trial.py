"""A trial in an object store: see `trial_contract.Trial`; its state is in `trial_state`, its record in `records`."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from analysis.records import CheckpointRecord, IterationRecord, TrialRecord
from policies.errors import MALFORMED, CannotRunError, CheckpointError, NotFoundError, TuneJobsError
from policies.files import open_to_append
from tune_jobs.store import names
from tune_jobs.store.logs import log_tail
from tune_jobs.store.manifests import files_of, read_manifest, verify_checkpoint
from tune_jobs.store.objects.at_once import side_by_side
from tune_jobs.store.objects.bucket import Listed
from tune_jobs.store.objects.logs import LogUploads
from tune_jobs.store.objects.outbox import outbox
from tune_jobs.store.objects.parts import Parts
from tune_jobs.store.objects.scratch import filling, make_local
from tune_jobs.store.objects.trial_state import TrialState
from tune_jobs.store.places import check_trial_id
from tune_jobs.store.results_file import ResultsFile, Scored
from tune_jobs.store.results_tail import NewPoints, ResultsMark
from tune_jobs.store.trial_contract import Ownership

_LOG = logging.getLogger(__name__)

_RUNNING_AFTER_S = 2.0
"""Seconds in which a newer record of a trial that runs may come, which is uploaded instead."""


class ObjectTrial:
    """One trial's objects; implements `Trial`.

    Args:
        parts: The sweep's objects.
        trial_id: `t0000` and so on.

    Raises:
        NotFoundError: This cannot be a trial's id.
    """

    def __init__(self, parts: Parts, trial_id: str) -> None:
        self.trial_id = check_trial_id(trial_id)
        self._parts = parts
        self._state = TrialState(parts, trial_id)
        self._log_uploads: LogUploads | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return ObjectTrial, (self._parts, self.trial_id)

    # -- who writes

    def take(self, under: Ownership | None = None) -> None:
        """Become the process that writes here; see `Trial.take`."""
        self._state.take(under)
        self._log_uploads = LogUploads(self._parts, self._log_key, self.log_path)

    @contextlib.contextmanager
    def _owning(self) -> Iterator[None]:
        self._state.check()
        yield

    def owned(self) -> AbstractContextManager[None]:
        """Return the context manager for writes other than these calls."""
        return self._owning()

    def is_lost(self) -> bool:
        """Whether this process has taken the trial, and another one has taken it since."""
        return self._state.is_lost()

    def settle(self) -> None:
        """Wait until everything that was written here is in the store; see `Trial.settle`."""
        wanted = [self._state.settle, *([] if self._log_uploads is None else [self._log_uploads.now])]
        side_by_side(lambda wait: wait(), wanted)

    # -- its record

    def read_record(self, listed: Listed | None = None) -> TrialRecord:
        """Read the record that the driver wrote last; `listed` is what a listing has just said of it."""
        record = self._parts.read_record(self._record_key, TrialRecord, "trial record", listed=listed)
        if record.trial_id != self.trial_id:
            raise CheckpointError(
                f"{self._parts.bucket.name_of(self._record_key)} is of trial {record.trial_id}, but it is that of "
                f"{self.trial_id}.",
                "Restore an earlier version of the object.",
            )
        return record

    def write_record(self, record: TrialRecord, *, soon: bool = False) -> None:
        """Replace the record; see `Trial.write_record`."""
        after_s = _RUNNING_AFTER_S if record.status == "running" else 0.0
        self._parts.write_record(self._record_key, record, soon=soon, after_s=after_s)

    def fetch(self, listed: Listed, *, results: bool) -> None:
        """Fetch the record, or all, for what is read in a moment; whatever fails is raised there."""
        with contextlib.suppress(TuneJobsError):
            record = self._parts.fetch_record(self._record_key, listed)
            if results:
                with contextlib.suppress(*MALFORMED):
                    self._state.is_over = record is not None and json.loads(record)["status"] == "completed"
                self._state.local()

    def fetch_checkpoint(self, iteration: int) -> None:
        """Fetch a checkpoint's files for what is read in a moment; whatever fails is raised there."""
        with contextlib.suppress(TuneJobsError, OSError):
            self._state.checkpoint_folder(iteration)

    @property
    def _record_key(self) -> str:
        return self._parts.record_key(self.trial_id)

    # -- its results

    def append_iterations(self, records: Sequence[IterationRecord]) -> None:
        """Append results."""
        if records:
            self._state.begin()
            self._state.local().append_iterations(records)
            self._state.changed(has_results=True)

    def keep_iterations(self, records: Sequence[IterationRecord]) -> None:
        """Replace all results by those up to the checkpoint that the trial continues from."""
        self._state.begin()
        with self._state.replacing_results():
            self._state.local().keep_iterations(records)

    def read_results(self, after: int = -1) -> ResultsFile:
        """Read the results."""
        with self._parts.named():
            return self._state.local().read_results(after)

    def read_iterations(self, after: int = -1) -> list[IterationRecord]:
        """Read the results that can be read, with rising iterations; a warning names what is left out."""
        found = self.read_results(after)
        for bad in found.bad:
            name = self._parts.bucket.name_of(f"{names.TRIALS_FOLDER}/{self.trial_id}")
            _LOG.warning("The results in %s are read without a line that is damaged: %s", name, bad)
        return found.records

    def read_new_points(self, since: ResultsMark) -> NewPoints:
        """Read the results that were appended since a mark."""
        with self._parts.named():
            return self._state.local().read_new_points(since)

    def scores_of(self, iterations: Collection[int]) -> dict[int, list[Scored]]:
        """Return the scores of some iterations in the results."""
        with self._parts.named():
            return self._state.local().scores_of(iterations)

    def has_results(self) -> bool:
        """Whether any results have been written."""
        return self._state.has_results()

    # -- its checkpoints

    def checkpoint_iterations(self) -> list[int]:
        """Return the iterations that have a checkpoint, in order."""
        return sorted(self._state.checkpoints())

    def checkpoint(self, iteration: int) -> CheckpointRecord:
        """Read a checkpoint's manifest; its files are not checked."""
        with self._parts.named():
            record = read_manifest(self._state.manifest_folder(iteration))
        if (record.trial_id, record.iteration) != (self.trial_id, iteration):
            raise CheckpointError(
                f"The manifest of checkpoint {iteration:06d} of trial {self.trial_id} in "
                f"{self._parts.bucket.url.short} is of trial {record.trial_id}, iteration {record.iteration}.",
                "The trial continues from its other checkpoints.",
            )
        return record

    def checkpoints(self) -> list[CheckpointRecord]:
        """Read the manifests of all checkpoints, oldest first."""
        found = []
        for iteration in self.checkpoint_iterations():
            with contextlib.suppress(_GoneError):
                found.append(self._present(iteration))
        return found

    def _present(self, iteration: int) -> CheckpointRecord:
        try:
            return self.checkpoint(iteration)
        except CheckpointError:
            raise
        except NotFoundError as error:
            raise _GoneError from error

    def checkpoint_folder(self, iteration: int) -> Path:
        """Return a local folder with a checkpoint's files."""
        return self._state.checkpoint_folder(iteration)

    @contextlib.contextmanager
    def reading_checkpoint(self, iteration: int) -> Iterator[Path]:
        """Yield a local folder with a checkpoint's files, which are removed after the block if it fetched them."""
        if self._state.is_writing:
            yield self.checkpoint_folder(iteration)
            return
        # Fetched for a reader of its own: what `checkpoint_folder` has returned stays.
        reader = TrialState(self._parts, self.trial_id)
        try:
            yield reader.checkpoint_folder(iteration)
        finally:
            # Its folder, with the two that trials lie in.
            shutil.rmtree(reader.folder().parents[1], ignore_errors=True)

    def verify_checkpoint(self, iteration: int) -> CheckpointRecord:
        """Check every file against the manifest."""
        with self._parts.named():
            return verify_checkpoint(self._state.checkpoint_folder(iteration))

    def checkpoint_files(self, iteration: int) -> dict[str, Path]:
        """Check every file of a checkpoint, and return them by their names."""
        self.verify_checkpoint(iteration)
        return files_of(self._state.checkpoint_folder(iteration))

    def write_checkpoint(self, record: CheckpointRecord, write: Callable[[Path], None], engine: str = "") -> None:
        """Write a checkpoint, which others see when all of it is in the store."""
        self._state.begin()
        self._state.local().write_checkpoint(record, write, engine)
        self._state.wrote_checkpoint(record.iteration)

    def delete_checkpoint(self, record: CheckpointRecord) -> None:
        """Remove a checkpoint."""
        self._state.begin()
        if record.iteration not in self._state.checkpoints():
            raise FileNotFoundError(f"Trial {self.trial_id} has no checkpoint {record.iteration}.")
        self._state.remove_checkpoint(record.iteration)

    # -- copies of other trials' checkpoints

    def copy_checkpoint(self, folder: Path, iteration: int) -> CheckpointRecord:
        """Copy a whole checkpoint; it is in the store when this returns."""
        return self._state.copies.copy(folder, iteration)

    def copied_checkpoint(self, iteration: int) -> Path:
        """Return a local folder with a copy; it does not exist if there is no copy."""
        return self._state.copies.fetch(iteration)

    def remove_copies(self, keep: Collection[int] = ()) -> None:
        """Delete copies; who has taken the trial does so once the store has the checkpoint that replaces them."""
        self._state.check()
        if self._state.is_taken:
            self._state.copies.note(keep)
            self._state.changed()
        else:
            self._state.copies.remove(keep)

    # -- what was damaged

    def keep_damaged_results(self, lines: Sequence[bytes]) -> None:
        """Keep lines that can't be read."""
        self._state.check()
        key = f"{self._folder}/{names.DAMAGED_RESULTS}"
        found = self._parts.bucket.get(key)
        self._parts.bucket.put(key, (found.data if found else b"") + b"".join(line + b"\n" for line in lines))

    def set_aside_results(self) -> str:
        """Move away results that can't be read at all."""
        self._state.begin()
        return f"{names.DAMAGED_FOLDER}/{self._state.set_aside_results()}"

    def set_aside(self, path: Path, prefix: str = "") -> str:
        """Take a damaged checkpoint or copy out of use; its files stay where they are."""
        self._state.begin()
        number = int(path.name)
        if prefix:
            name, copies = f"{prefix}{path.name}", self._state.copies
            target = f"{self._folder}/{names.DAMAGED_FOLDER}/{name}"
            source = f"{copies.prefix_of(number)}/"
            for item in self._parts.bucket.listed(source):
                found = self._parts.bucket.get(item.key)
                if found is not None:
                    self._parts.bucket.put(f"{target}/{item.key.removeprefix(source)}", found.data)
            # At once: a damaged copy is replaced by no checkpoint.
            copies.remove([copy for copy in copies.iterations() if copy != number])
            return f"{names.DAMAGED_FOLDER}/{name}"
        return f"{names.DAMAGED_FOLDER}/{self._state.set_aside(number)}"

    def latest_damaged(self) -> int:
        """Return the latest iteration of a checkpoint that was set aside; 0 if there is none."""
        return self._state.latest_damaged()

    def remove_leftovers(self) -> None:
        """Remove objects that no head names any more."""
        self._state.remove_leftovers()

    def leftovers(self, present: Sequence[str]) -> list[str]:
        """Return those of the trial's objects, which were listed before this call, that no head names any more."""
        return self._state.leftovers(present) if present else []

    # -- its curves, log and tally

    def append_events(self, name: str, data: bytes) -> None:
        """Append to one of the trial's event files, or to one that follows it; see `Parts.append`."""
        self._parts.append(f"{self._folder}/{names.EVENTS_FOLDER}/{Path(name).name}", data)

    @property
    def log_path(self) -> Path:
        """A file of this machine that the trial's process appends its output to."""
        folder = self._parts.shared() / names.TRIALS_FOLDER / self.trial_id
        make_local(folder)
        return folder / names.TRIAL_LOG

    def write_log(self, text: str) -> None:
        """Append a line to the log, with the time and this process."""
        line = f"{time.strftime('%Y-%m-%d %H:%M:%S')} process {os.getpid()}: {text}\n"
        path = self.log_path
        with filling(), open_to_append(path) as file:
            file.write(line.encode(errors="backslashreplace"))
        if self._log_uploads is None:
            # Who says something of a trial does not wait for the store; of a log, nobody waits for the end.
            with contextlib.suppress(TuneJobsError):
                outbox().add(("log", self._log_key, id(self)), LogUploads(self._parts, self._log_key, path).bring)

    def newest_log(self) -> Path:
        """Return this machine's file, or a copy of the store's if that is newer."""
        return self._parts.newest_log(self._log_key, self.log_path)

    def log_tail(self, num_lines: int = 15) -> str:
        """Return the lines that say how the trial's last process ended."""
        return log_tail(self.newest_log(), f"trial {self.trial_id}", num_lines)

    @property
    def _log_key(self) -> str:
        return f"{self._folder}/{names.TRIAL_LOG}"

    @property
    def _folder(self) -> str:
        return f"{names.TRIALS_FOLDER}/{self.trial_id}"

    @property
    def tally_path(self) -> Path:
        """A file of this machine that says how far the trial is while a process here trains it."""
        return self.log_path.with_name(names.TALLY)

    def forget_tally(self) -> None:
        """Delete the tally."""
        self._state.check()
        with contextlib.suppress(OSError, CannotRunError):
            self.tally_path.unlink(missing_ok=True)


class _GoneError(Exception):
    """A checkpoint was deleted while it was looked for."""

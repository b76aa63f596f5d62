"""A sweep in a folder of the local store. See `contract.Sweep` for who may write what and when.

The layout is in `docs/design.md`, "On disk"; the names of the parts are in `names`.
"""

from __future__ import annotations

import contextlib
import secrets
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from analysis.best_records import BestRecord, FilmsRecord
from analysis.records import FINISHED, CheckpointRecord, SweepRecord, TrialRecord
from policies.errors import CannotRunError, CheckpointError, NotFoundError, TuneJobsError
from policies.files import absolute, write_atomic
from policies.portable.file import PortablePolicy, save_policy
from tune_jobs.store import names
from tune_jobs.store.command_names import name_in_commands, name_taken, still_driven, watch_or_end
from tune_jobs.store.fresh_look import FreshLook
from tune_jobs.store.leftovers import remove_abandoned
from tune_jobs.store.locks import held, is_held
from tune_jobs.store.ownership import Owner
from tune_jobs.store.pack_files import PackFiles
from tune_jobs.store.places import (
    is_trial_id,
    names_in,
    not_older,
    parts_of,
    refuse_link,
    refuse_linked_sweep,
    refuse_links_in,
    remove_file,
    remove_folder,
    stamp_of,
    within,
)
from tune_jobs.store.presence import is_file
from tune_jobs.store.probe import Probe, probing
from tune_jobs.store.record_files import dump, dump_sealed, read_record
from tune_jobs.store.removal import check_not_removed, put_aside, remove_sweep, unless_removed
from tune_jobs.store.trial_store import TrialStore


class SweepStore:
    """One sweep's folder; implements `Sweep`."""

    def __init__(self, folder: Path) -> None:
        # Ray takes only absolute paths for storage ("URI has empty scheme" otherwise).
        self.folder = absolute(folder)
        self.record_path = self.folder / names.SWEEP_RECORD
        self._stop_path = self.folder / names.STOP_REQUEST
        self._lock_path = self.folder / names.LOCK
        self._driver_lock_path = self.folder / names.DRIVER_LOCK
        self._made: list[Path] = []
        self._aside: Path | None = None
        """The folder that `discard` has removed, but for a file that is open."""
        self._look = FreshLook(self.folder)

    @property
    def place(self) -> str:
        """The folder, as a text."""
        return str(self.folder)

    @property
    def best_folder(self) -> Path:
        """The folder with the winner's policy, its evaluation and films; it has no links in it."""
        return refuse_links_in(self.folder / names.BEST_FOLDER)

    @property
    def report_folder(self) -> Path:
        """The report's folder."""
        return within(self.folder, names.REPORT_FOLDER)

    @property
    def tune_folder(self) -> Path:
        """The folder of Ray Tune's own state."""
        return within(self.folder, names.RAY_TUNE_FOLDER)

    def clear_tune_folder(self) -> None:
        """Delete Ray Tune's state of an earlier run."""
        remove_folder(self.tune_folder)

    @property
    def driver_log(self) -> Path:
        """The log of what Ray and RLlib print in the process that drives the sweep."""
        return within(self.folder, names.DRIVER_LOG)

    @property
    def name(self) -> str:
        """The sweep's name, which is its folder's."""
        return self.folder.name

    def exists(self) -> bool:
        """Whether there is a sweep here; one that this user may not read counts, and is refused when it is read.

        Raises:
            CheckpointError: The storage gives no answer.
        """
        try:
            return is_file(self.record_path)
        except CheckpointError as error:
            if isinstance(error.__cause__, PermissionError):
                return True
            raise

    def create(self) -> None:
        """Make the folder; of several processes that want the same name, one gets it.

        Raises:
            SpecError: The folder exists already.
            CannotRunError: The storage folder cannot be written.
        """
        root = self.folder.parent
        try:
            self._made = [folder for folder in (root, *root.parents) if not folder.exists()]
            root.mkdir(parents=True, exist_ok=True)
            try:
                self.folder.mkdir()
            except FileExistsError as error:
                raise name_taken(self.folder, is_sweep=self.exists()) from error
            try:
                (self.folder / names.TRIALS_FOLDER).mkdir()
            except OSError:
                # An empty folder would hold the name for ever.
                self.discard()
                raise
        except OSError as error:
            raise CannotRunError(
                f"The storage folder {root} cannot be written: {error.strerror or error}.",
                "Choose another with --storage, or set TUNE_JOBS_STORAGE.",
            ) from error

    def discard(self) -> None:
        """Undo `create`: remove the folder, and the folders above it that it made."""
        left = self.folder
        with contextlib.suppress(OSError, TuneJobsError):
            refuse_linked_sweep(self.folder)
            left = self._aside = put_aside(self.folder)
        shutil.rmtree(left, ignore_errors=True)
        with contextlib.suppress(OSError):
            for folder in self._made:
                folder.rmdir()

    def delete(self) -> None:
        """Remove the folder.

        Raises:
            CannotRunError: A process drives the sweep, or the folder cannot be removed, such as a symbolic link.
        """
        remove_sweep(self.folder, self.lock())

    @contextlib.contextmanager
    def rehearsal(self) -> Iterator[SweepStore]:
        """Yield a sweep in a hidden folder beside this one, which is removed after the block.

        Raises:
            CannotRunError: The storage folder cannot be written.
        """
        other = SweepStore(self.folder.with_name(f".{self.name}.{secrets.token_hex(4)}"))
        other.create()
        try:
            yield other
        finally:
            other.discard()

    def read_record(self) -> SweepRecord:
        """Read sweep.json.

        Raises:
            NotFoundError: There is no such file.
            CheckpointError: It is damaged or of a newer format.
        """
        refuse_link(self.record_path)
        return read_record(self.record_path, SweepRecord, "sweep")

    def record_stamp(self) -> tuple[int, ...]:
        """Return the inode, the size and the time of sweep.json."""
        return stamp_of(self.record_path)

    def write_record(self, record: SweepRecord) -> None:
        """Replace sweep.json."""
        write_atomic(self.record_path, dump(record))

    def settle(self) -> None:
        """Do nothing: what was written is on disk."""

    def trial(self, trial_id: str) -> TrialStore:
        """Return the folder of one trial.

        Raises:
            NotFoundError: This cannot be a trial's id.
        """
        return TrialStore(self.folder, trial_id)

    @contextlib.contextmanager
    def reading(self, *, results: bool = True, checkpoints: Sequence[CheckpointRecord] = ()) -> Iterator[None]:  # noqa: ARG002
        """Do nothing: a file is read when it is needed."""
        yield

    def pack(self, pack_id: str) -> PackFiles:
        """Return the files of one pack.

        Raises:
            NotFoundError: This cannot be a pack's id.
        """
        return PackFiles(self.folder, pack_id)

    def checkpoint_folder(self, record: CheckpointRecord) -> Path:
        """Return the folder of a checkpoint.

        Raises:
            CheckpointError: A symbolic link is in the way.
        """
        return self.trial(record.trial_id).checkpoint_folder(record.iteration)

    def read_trials(self) -> list[TrialRecord]:
        """Read every trial's record, by index."""
        folders = parts_of(within(self.folder, names.TRIALS_FOLDER))
        stores = [self.trial(path.name) for path in folders if is_trial_id(path.name)]
        records = [store.read_record() for store in stores if is_file(store.record_path)]
        return sorted(records, key=lambda record: record.index)

    def trial_stamps(self) -> dict[str, tuple[int, ...]]:
        """Return inode, time and size of each trial.json; see `Sweep.trial_stamps`."""
        # Of ten thousand trials, several times a second: texts are joined much faster than paths.
        folder = within(self.folder, names.TRIALS_FOLDER)
        trial_ids = filter(is_trial_id, names_in(folder))
        found = ((trial_id, stamp_of(f"{folder}/{trial_id}/{names.TRIAL_RECORD}")) for trial_id in trial_ids)
        return {trial_id: stamp for trial_id, stamp in found if stamp}

    def read_best(self) -> BestRecord:
        """Read best/evaluation.json.

        Raises:
            NotFoundError: No best policy has been chosen yet.
        """
        path = within(self.best_folder, names.BEST_RECORD)
        if not is_file(path):
            raise NotFoundError(
                f"Sweep {self.name} has no best policy yet.",
                f"Choose it with `tune-jobs best {name_in_commands(self.place)}`.",
            )
        return read_record(path, BestRecord, "best record", is_sealed=True)

    def has_best(self) -> bool:
        """Whether a best policy has been chosen."""
        return is_file(self.best_folder / names.BEST_RECORD)

    def best_stamp(self) -> tuple[int, ...]:
        """Return the inode, the size and the time of the winner's record."""
        return stamp_of(self.best_folder / names.BEST_RECORD)

    def write_best(self, record: BestRecord, policy: PortablePolicy | None = None) -> None:
        """Replace the winner's record and its policy; the policy is written first.

        Args:
            record: The content of best/evaluation.json.
            policy: The winner's policy; None: the present one is kept.

        Raises:
            NotFoundError: The sweep was removed.
        """
        check_not_removed(self.folder)
        if policy is not None:
            save_policy(policy, self.best_folder)
        write_atomic(self.best_folder / names.BEST_RECORD, dump_sealed(record))

    @property
    def best_policy_path(self) -> Path:
        """The path of the winner's policy."""
        return self.best_folder / names.BEST_POLICY

    def films(self) -> dict[str, Path]:
        """Return the films that exist of the present winner; see `Sweep.films`."""
        folder = self.best_folder
        films = {key: folder / name for key, name in names.FILMS.items() if (folder / name).is_file()}
        return films if films and self._are_of_the_winner(films.values()) else {}

    def _are_of_the_winner(self, films: Iterable[Path]) -> bool:
        path = within(self.best_folder, names.FILMS_RECORD)
        try:
            if is_file(path):
                record = read_record(path, FilmsRecord, "films record", is_sealed=True)
                return record.checkpoint == self.read_best().checkpoint
        except (CheckpointError, NotFoundError):
            return False
        # Older versions wrote no such record, and neither does a process that is ended while it films.
        return self.has_best() and not_older(films, [self.best_folder / names.BEST_RECORD])

    def current_films(self) -> dict[str, Path]:
        """Return all films, if they are of the present winner; see `Sweep.current_films`."""
        films = self.films()
        return films if len(films) == len(names.FILMS) else {}

    @contextlib.contextmanager
    def writing_films(self) -> Iterator[Mapping[str, Path]]:
        """Yield the paths to write films of the present winner to, by the names that `films` has."""
        folder = self.best_folder
        record = within(folder, names.FILMS_RECORD)
        shown = self.read_best().checkpoint
        remove_file(record)
        with unless_removed(self.folder, folder):
            yield {key: folder / name for key, name in names.FILMS.items()}
        write_atomic(record, dump_sealed(FilmsRecord(checkpoint=shown)))

    def current_report(self) -> Path | None:
        """Return the report's page, if nothing that it shows was written since; see `Sweep.current_report`."""
        page = within(self.report_folder, names.REPORT_PAGE)
        shown = [self.record_path, self.best_folder / names.BEST_RECORD, *self.films().values()]
        return page if not_older([page], shown) else None

    def report_files(self) -> dict[str, Path]:
        """Return the report's files by their paths in its folder; see `Sweep.report_files`."""
        folder = refuse_links_in(self.report_folder)
        # Hidden ones are being written.
        files = (path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.startswith("."))
        return {path.relative_to(folder).as_posix(): path for path in files}

    @contextlib.contextmanager
    def writing_report(self) -> Iterator[Path]:
        """Yield the folder to write the report into; it has no links in it."""
        folder = refuse_links_in(self.report_folder)
        with unless_removed(self.folder, folder):
            yield folder

    def request_stop(self) -> None:
        """Ask the process that drives this sweep to stop."""
        write_atomic(self._stop_path, "stop\n")

    def stop_requested(self) -> bool:
        """Whether a process asked to stop, on whichever machine."""
        self._look.take()
        return self._stop_path.exists()

    def clear_stop_request(self) -> None:
        """Forget the request."""
        remove_file(self._stop_path)

    def take(self) -> Owner:
        """Become the run of this sweep; processes of an earlier run can't write any more.

        Raises:
            CannotRunError: The folder cannot be written or locked.
        """
        return Owner.take(self._owner_path)

    def owner(self, token: str) -> Owner:
        """Return the run whose token another process has passed on."""
        return Owner(self._owner_path, token)

    @property
    def _owner_path(self) -> Path:
        return within(self.folder, names.OWNER)

    def remove_leftovers(self) -> None:
        """Remove incomplete files of killed processes; see `Sweep.remove_leftovers`."""
        trials = self.read_trials()
        remove_abandoned(self.folder, [trial.trial_id for trial in trials])
        for trial in trials:
            # The process that takes another trial removes its incomplete files.
            if trial.status in FINISHED:
                self.trial(trial.trial_id).remove_leftovers()

    def probing(self) -> AbstractContextManager[Probe]:
        """Find out whether other machines see the same folder; see `Sweep.probing`."""
        return probing(self.folder)

    def is_driven(self) -> bool:
        """Whether a process drives this sweep now (on this machine, or on one that shares locks with it)."""
        return is_held(self._lock_path) or is_held(self._driver_lock_path)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the sweep's lock; the system frees it when the process ends, however it ends.

        Raises:
            CannotRunError: Another process holds it, or runs the sweep on a cluster.
        """
        told = f"Sweep {self.name} is being run by another process."
        with held(self._lock_path, told, watch_or_end(self.place)):
            if is_held(self._driver_lock_path):
                raise CannotRunError(*still_driven(self.name))
            yield
        if self._aside is not None:
            # The lock's file is open no longer.
            shutil.rmtree(self._aside, ignore_errors=True)

    @contextlib.contextmanager
    def driver_lock(self) -> Iterator[None]:
        """Hold the lock of a process that drives the sweep on a cluster, for a client that holds the sweep's lock.

        Raises:
            CannotRunError: Such a process still runs.
        """
        with held(self._driver_lock_path, *still_driven(self.name)):
            yield

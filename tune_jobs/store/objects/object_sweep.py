"""A sweep in an object store; see `contract.Sweep` for who may write what and when."""

from __future__ import annotations

import contextlib
import hashlib
import secrets
import shutil
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from analysis.records import FINISHED, BestRecord, CheckpointRecord, FilmsRecord, SweepRecord, TrialRecord
from policies.errors import CannotRunError, CheckpointError, NotFoundError, SpecError
from policies.portable.file import PortablePolicy, save_policy
from tune_jobs.store import names
from tune_jobs.store.objects.asked import Asked
from tune_jobs.store.objects.bucket import ConflictError, Listed, StorageError, Tag
from tune_jobs.store.objects.lease import LEASE_S, is_leased, leased
from tune_jobs.store.objects.logs import LogUploads
from tune_jobs.store.objects.object_pack import ObjectPack
from tune_jobs.store.objects.object_trial import ObjectTrial
from tune_jobs.store.objects.outbox import outbox
from tune_jobs.store.objects.owners import ObjectOwner
from tune_jobs.store.objects.parts import RECORDS, Parts
from tune_jobs.store.objects.probe import ObjectProbe, probing
from tune_jobs.store.objects.url import ObjectUrl
from tune_jobs.store.places import is_trial_id
from tune_jobs.store.record_files import dump_sealed

_LOCK, _DRIVER_LOCK, _RUN = "lock.json", "driver-lock.json", "run.json"
_CLAIM, _STOP = "claim", "stop"
_AT_ONCE = 32
"""Requests side by side when many records are read."""


class ObjectSweep:
    """One sweep's objects; implements `Sweep`.

    Args:
        url: Its address.
    """

    def __init__(self, url: ObjectUrl) -> None:
        self.url = url
        self._parts = Parts(url)
        self._bucket = self._parts.bucket
        self._stop = Asked(lambda: self._bucket.get(_STOP) is not None)
        self._driver_uploads: LogUploads | None = None
        # One for all calls, so that what a trial has fetched is fetched once.
        self._trials: dict[str, ObjectTrial] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        # What Ray carries to another process is opened anew there.
        return ObjectSweep, (self.url,)

    @property
    def place(self) -> str:
        """The sweep's address."""
        return str(self.url)

    @property
    def name(self) -> str:
        """The sweep's name."""
        return self.url.name

    # -- its existence

    def exists(self) -> bool:
        """Whether the sweep exists."""
        return bool(self.record_stamp())

    def create(self) -> None:
        """Take the name; of several processes that want it at once, one gets it."""
        try:
            if self.is_taken():
                raise name_taken(self.url)
            self._bucket.put(_CLAIM, secrets.token_bytes(8), is_new=True)
        except ConflictError as error:
            raise name_taken(self.url) from error

    def is_taken(self) -> bool:
        """Whether there is anything of a sweep here."""
        folders, objects = self._bucket.children()
        return bool(folders or objects)

    def discard(self) -> None:
        """Undo `create`, including everything that was written since."""
        outbox().forget(self._parts.jobs)
        with contextlib.suppress(StorageError):
            self._bucket.delete([item.key for item in self._bucket.listed()])
        shutil.rmtree(self._parts.shared(), ignore_errors=True)

    def delete(self) -> None:
        """Remove the sweep, with everything in it."""
        with self.lock():
            outbox().forget(self._parts.jobs)
            self._bucket.delete([names.SWEEP_RECORD])
            self._bucket.delete([item.key for item in self._bucket.listed() if item.key != _LOCK])
        self._bucket.delete([_LOCK])
        shutil.rmtree(self._parts.shared(), ignore_errors=True)

    @contextlib.contextmanager
    def rehearsal(self) -> Iterator[ObjectSweep]:
        """Yield a hidden sweep beside this one, which is discarded after the block."""
        other = ObjectSweep(self.url.parent.child(f".{self.name}.{secrets.token_hex(4)}"))
        other.create()
        try:
            yield other
        finally:
            other.discard()

    # -- its record and its parts

    def read_record(self) -> SweepRecord:
        """Read the record that the driver wrote last."""
        return self._parts.read_record(names.SWEEP_RECORD, SweepRecord, "sweep")

    def record_stamp(self) -> tuple[int, ...]:
        """Return what changes whenever the record is written; empty: there is no record."""
        return _stamp(self._bucket.look(names.SWEEP_RECORD))

    def write_record(self, record: SweepRecord) -> None:
        """Replace the record; all records of trials that were written before are in the store then."""
        self.settle()
        self._parts.write_record(names.SWEEP_RECORD, record)

    def settle(self) -> None:
        """Wait until all records that were written here are in the store; see `Sweep.settle`."""
        self._parts.settle()

    def trial(self, trial_id: str) -> ObjectTrial:
        """Return a trial, which need not exist yet."""
        if trial_id not in self._trials:
            self._trials[trial_id] = ObjectTrial(self._parts, trial_id)
        return self._trials[trial_id]

    def read_trials(self) -> list[TrialRecord]:
        """Read the records of all trials that have one, by index."""
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            records = list(pool.map(lambda trial_id: self.trial(trial_id).read_record(), self.trial_stamps()))
        return sorted(records, key=lambda record: record.index)

    def trial_stamps(self) -> dict[str, tuple[int, ...]]:
        """Return what changes whenever a trial's record is written, by id."""
        try:
            listed = self._bucket.listed(f"{RECORDS}/")
        except StorageError as error:
            raise CheckpointError(error.message, error.hint) from error
        found = {item.key.removeprefix(f"{RECORDS}/").removesuffix(".json"): _stamp(item) for item in listed}
        return {trial_id: stamp for trial_id, stamp in found.items() if is_trial_id(trial_id)}

    def pack(self, pack_id: str) -> ObjectPack:
        """Return a pack, which need not exist yet."""
        return ObjectPack(self._parts, pack_id)

    def checkpoint_folder(self, record: CheckpointRecord) -> Path:
        """Return a local folder with a checkpoint's files."""
        return self.trial(record.trial_id).checkpoint_folder(record.iteration)

    # -- who drives it

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Be the sweep's driver in the block; the lock is free half a minute after the process has ended."""
        watch = f"Watch it with `tune-jobs status {self.name}`, or end it with `tune-jobs stop {self.name}`."
        with leased(self._bucket, _LOCK, f"Sweep {self.name} is being run by another process.", watch) as is_ours:
            if is_leased(self._bucket, _DRIVER_LOCK, watch_s=LEASE_S):
                raise CannotRunError(*self._still_driven)
            self._parts.is_locked = is_ours
            try:
                yield
            finally:
                # What a block has written is there when another process gets the lock.
                self.settle()
                if self._driver_uploads is not None:
                    self._driver_uploads.now()
                self._parts.is_locked = None

    @contextlib.contextmanager
    def driver_lock(self) -> Iterator[None]:
        """Drive it on a cluster, for a client that holds `lock`."""
        with leased(self._bucket, _DRIVER_LOCK, *self._still_driven):
            yield

    @property
    def _still_driven(self) -> tuple[str, str]:
        return (
            f"A cluster still runs sweep {self.name}, for a process that has ended.",
            "Try again in a minute: the cluster is ending the run.",
        )

    def is_driven(self) -> bool:
        """Whether a process holds one of the locks."""
        return is_leased(self._bucket, _LOCK) or is_leased(self._bucket, _DRIVER_LOCK)

    def take(self) -> ObjectOwner:
        """Become the sweep's run: no process of an earlier run can take a trial or a pack any more."""
        self._parts.run = ObjectOwner.take(self._bucket, _RUN)
        return self._parts.run

    def owner(self, token: str) -> ObjectOwner:
        """Return the run whose token another process has passed on."""
        self._parts.run = ObjectOwner(self._bucket, _RUN, token)
        return self._parts.run

    def remove_leftovers(self) -> None:
        """Remove objects that killed processes left behind; the caller has to hold the lock."""
        ended = [trial.trial_id for trial in self.read_trials() if trial.status in FINISHED]
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            list(pool.map(lambda trial_id: self.trial(trial_id).remove_leftovers(), ended))
        self._bucket.delete([item.key for item in self._bucket.listed("probe/")])

    def probing(self) -> AbstractContextManager[ObjectProbe]:
        """Find out in the block whether other machines reach the same sweep."""
        return probing(self._bucket)

    def request_stop(self) -> None:
        """Ask the driver to stop; any process may."""
        self._bucket.put(_STOP, b"stop\n")
        self._stop.forget()

    def stop_requested(self) -> bool:
        """Whether a stop was requested since `clear_stop_request`."""
        return self._stop.answer()

    def clear_stop_request(self) -> None:
        """Forget the request."""
        self._bucket.delete([_STOP])
        self._stop.forget()

    # -- its results: made in a folder that this machine's processes share, so that paths which users are told stay

    def _shared(self, folder: str, *, fetched: bool = True) -> Path:
        """Return the local folder of the winner or the report, with what the store has of it."""
        local = self._parts.shared() / folder
        local.mkdir(parents=True, exist_ok=True)
        if fetched:
            present = {item.key.removeprefix(f"{folder}/"): item for item in self._bucket.listed(f"{folder}/")}
            stale = [name for name, item in present.items() if _differs(local / name, item)]
            with ThreadPoolExecutor(_AT_ONCE) as pool:
                list(pool.map(lambda name: self._fetch(folder, name, present[name]), stale))
            for path in [path for path in local.rglob("*") if path.is_file()]:
                name = path.relative_to(local).as_posix()
                if name not in present and not path.name.startswith("."):
                    path.unlink(missing_ok=True)
        return local

    def _fetch(self, folder: str, name: str, item: Listed) -> None:
        path = self._parts.shared() / folder / name
        if self._bucket.fetch(f"{folder}/{name}", path):
            _mark(path, item.tag)

    def _upload(self, folder: str, made: Path, paths: Sequence[Path]) -> None:
        for path in paths:
            self._bucket.put(f"{folder}/{path.relative_to(made).as_posix()}", path)

    def has_best(self) -> bool:
        """Whether a winner has been written."""
        return self._bucket.get(f"{names.BEST_FOLDER}/{names.BEST_RECORD}") is not None

    def read_best(self) -> BestRecord:
        """Read the winner's record."""
        key = f"{names.BEST_FOLDER}/{names.BEST_RECORD}"
        try:
            return self._parts.read_record(key, BestRecord, "best record", is_sealed=True)
        except CheckpointError:
            raise
        except NotFoundError as error:
            raise NotFoundError(
                f"Sweep {self.name} has no best policy yet.", f"Choose it with `tune-jobs best {self.name}`."
            ) from error

    def write_best(self, record: BestRecord, policy: PortablePolicy | None = None) -> None:
        """Replace the winner; the sealed record is written after the policy."""
        if policy is not None:
            made = self._parts.own() / "made" / names.BEST_FOLDER
            save_policy(policy, made)
            self._upload(names.BEST_FOLDER, made, sorted(made.iterdir()))
        self._parts.write_record(f"{names.BEST_FOLDER}/{names.BEST_RECORD}", dump_sealed(record))

    @property
    def best_folder(self) -> Path:
        """A local folder with the winner's portable policy."""
        return self._shared(names.BEST_FOLDER)

    @property
    def best_policy_path(self) -> Path:
        """The file in `best_folder` that a user is told to load."""
        return self._shared(names.BEST_FOLDER, fetched=False) / names.BEST_POLICY

    def films(self) -> dict[str, Path]:
        """Return the films that exist of the present winner."""
        folder = self.best_folder
        films = {key: folder / name for key, name in names.FILMS.items() if (folder / name).is_file()}
        return films if films and self._are_of_the_winner() else {}

    def _are_of_the_winner(self) -> bool:
        key = f"{names.BEST_FOLDER}/{names.FILMS_RECORD}"
        try:
            record = self._parts.read_record(key, FilmsRecord, "films record", is_sealed=True)
            return record.checkpoint == self.read_best().checkpoint
        except NotFoundError:
            return False

    def current_films(self) -> dict[str, Path]:
        """Return all films if they are there and show the present winner; else none."""
        films = self.films()
        return films if len(films) == len(names.FILMS) else {}

    @contextlib.contextmanager
    def writing_films(self) -> Iterator[Mapping[str, Path]]:
        """Yield the path for each of the films of the present winner."""
        # Not where others look: those bring that folder to what the store has.
        made = self._parts.own() / "made" / f"films-{secrets.token_hex(4)}"
        made.mkdir(parents=True)
        shown = self.read_best().checkpoint
        key = f"{names.BEST_FOLDER}/{names.FILMS_RECORD}"
        self._bucket.delete([key])
        paths = {film: made / name for film, name in names.FILMS.items()}
        yield paths
        self._upload(names.BEST_FOLDER, made, [path for path in paths.values() if path.is_file()])
        self._parts.write_record(key, dump_sealed(FilmsRecord(checkpoint=shown)))

    def current_report(self) -> Path | None:
        """Return the report's page if it was written after the sweep's record, the winner and the films; else None."""
        # Not of all objects: the trials may have many thousands.
        items = [*self._bucket.listed(f"{names.BEST_FOLDER}/"), *self._bucket.listed(f"{names.REPORT_FOLDER}/")]
        record = self._bucket.look(names.SWEEP_RECORD)
        listed = {item.key: item.modified_s for item in [*items, *([record] if record is not None else [])]}
        page = listed.get(f"{names.REPORT_FOLDER}/{names.REPORT_PAGE}")
        of_best = (names.BEST_RECORD, *names.FILMS.values())
        shown = [names.SWEEP_RECORD, *(f"{names.BEST_FOLDER}/{name}" for name in of_best)]
        if page is None or any(listed.get(key, page) > page for key in shown):
            return None
        return self._shared(names.REPORT_FOLDER) / names.REPORT_PAGE

    def report_files(self) -> dict[str, Path]:
        """Return the files of the report that was written last, by their names."""
        folder = self._shared(names.REPORT_FOLDER)
        files = (path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.startswith("."))
        return {path.relative_to(folder).as_posix(): path for path in files}

    @contextlib.contextmanager
    def writing_report(self) -> Iterator[Path]:
        """Yield a local folder to write the report into, over the present one."""
        folder = self._parts.own() / "made" / f"report-{secrets.token_hex(4)}"
        shutil.copytree(self._shared(names.REPORT_FOLDER), folder, ignore=shutil.ignore_patterns(".*"))
        yield folder
        files = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.startswith(".")]
        page = folder / names.REPORT_PAGE
        self._upload(names.REPORT_FOLDER, folder, [path for path in files if path != page])
        # Last: a page whose figures are missing would be half a report.
        self._upload(names.REPORT_FOLDER, folder, [page] if page.is_file() else [])

    # -- files of this machine and this run only

    @property
    def driver_log(self) -> Path:
        """A file of this machine that the process that drives the sweep prints to; its end is in the store, too."""
        path = self._parts.shared() / names.DRIVER_LOG
        if self._driver_uploads is None:
            self._driver_uploads = LogUploads(self._parts, names.DRIVER_LOG, path)
        return path

    @property
    def tune_folder(self) -> Path:
        """A folder of this machine for Ray Tune's own state."""
        return self._parts.shared() / names.RAY_TUNE_FOLDER

    def clear_tune_folder(self) -> None:
        """Delete Ray Tune's state of an earlier run."""
        shutil.rmtree(self.tune_folder, ignore_errors=True)


def name_taken(url: ObjectUrl) -> SpecError:
    """Return the error that a name is taken."""
    go_on = f"continue it: `tune-jobs resume {url.name}`"
    other = go_on if ObjectSweep(url).exists() else f"remove what is there: it has no {names.SWEEP_RECORD}"
    hint = f"Choose another name with --name, or {other}."
    return SpecError(f"A sweep {url.name!r} is already in {url.parent.short}.", hint)


def _stamp(item: Listed | None) -> tuple[int, ...]:
    if item is None:
        return ()
    digest = hashlib.sha256(repr(item.tag).encode()).digest()
    return int.from_bytes(digest[:8]), item.size, int(item.modified_s)


def _marked(path: Path) -> Path:
    return path.with_name(f".{path.name}.tag")


def _mark(path: Path, tag: Tag) -> None:
    """Note which content of an object a local file has."""
    found = path.stat()
    _marked(path).write_text(repr((tag, found.st_size, found.st_mtime_ns)), encoding="utf-8")


def _differs(path: Path, item: Listed) -> bool:
    """Whether a local file is missing, or is not the content that an object has."""
    try:
        found = path.stat()
        noted = _marked(path).read_text(encoding="utf-8")
    except OSError:
        return True
    return noted != repr((item.tag, found.st_size, found.st_mtime_ns))

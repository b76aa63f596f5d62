"""A sweep in an object store; see `contract.Sweep` for who may write what and when."""

from __future__ import annotations

import contextlib
import contextvars
import functools
import hashlib
import itertools
import secrets
import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from analysis.records import FINISHED, CheckpointRecord, SweepRecord, TrialRecord
from policies.errors import CannotRunError, CheckpointError, SpecError
from tune_jobs.store import names
from tune_jobs.store.command_names import name_in_commands, still_driven, watch_or_end
from tune_jobs.store.objects.asked import Asked
from tune_jobs.store.objects.at_once import AT_ONCE, side_by_side
from tune_jobs.store.objects.bucket import ConflictError, Listed, StorageError
from tune_jobs.store.objects.held import held, holding
from tune_jobs.store.objects.lease import LEASE_S, is_leased, leased
from tune_jobs.store.objects.logs import LogUploads
from tune_jobs.store.objects.object_artifacts import Artifacts
from tune_jobs.store.objects.object_pack import ObjectPack
from tune_jobs.store.objects.object_trial import ObjectTrial
from tune_jobs.store.objects.outbox import outbox
from tune_jobs.store.objects.owners import RUN, ObjectOwner
from tune_jobs.store.objects.parts import RECORDS, Parts
from tune_jobs.store.objects.probe import FOLDER as PROBE_FOLDER
from tune_jobs.store.objects.probe import ObjectProbe, probing
from tune_jobs.store.objects.url import ObjectUrl
from tune_jobs.store.places import is_trial_id
from tune_jobs.store.removal import removed_meanwhile

_LOCK, _DRIVER_LOCK = "lock.json", "driver-lock.json"
_CLAIM, _STOP = "claim", "stop"
OF_A_NEW_SWEEP = frozenset({_CLAIM, _LOCK, RECORDS})
"""What there is of a sweep before its record."""
_UNCLAIM_S = 2.0
"""How long it is waited for that a name is free again."""


class ObjectSweep(Artifacts):
    """One sweep's objects; implements `Sweep`.

    Args:
        url: Its address.
    """

    def __init__(self, url: ObjectUrl) -> None:
        self.url = url
        super().__init__(Parts(url))
        bucket = self._bucket
        # Not of this sweep, which would live on in a circle, and its folder with it.
        self._stop = Asked(lambda: bucket.get(_STOP) is not None)
        self._driver_uploads: LogUploads | None = None
        self._is_made = False
        """Whether this process has made the sweep."""
        self._has_results = False
        """Whether results belong to what was fetched for those who read much."""
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
        ours = held(self.url)
        return (ours is not None and ours.found(names.SWEEP_RECORD) is not None) or bool(self.record_stamp())

    def check_not_removed(self) -> None:
        """Check that there is anything of it still: its record, or the claim of its name before that."""
        if not self.exists() and self._bucket.look(_CLAIM) is None:
            raise removed_meanwhile(self.name)

    def create(self) -> None:
        """Take the name; of several processes that want it at once, one gets it.

        Raises:
            SpecError: The name is taken.
            StorageError: The store doesn't answer, or refuses.
        """
        claim = secrets.token_bytes(8)
        try:
            asked: list[Callable[[], bool]] = [
                functools.partial(self._claim, claim),
                functools.partial(self._has, apart_from=_CLAIM),
            ]
            _, has_others = side_by_side(_answer, asked)
        except ConflictError as error:
            raise name_taken(self.url) from error
        except StorageError:
            # It may be there all the same, and would hold the name for ever. Who wants an answer now doesn't wait for
            # a store that is away; a thread of its own is not told to be as impatient.
            undoing = threading.Thread(target=self._unclaim, args=(claim,), daemon=True)
            undoing.start()
            undoing.join(_UNCLAIM_S)
            raise
        if has_others:
            self._bucket.delete([_CLAIM])
            raise name_taken(self.url)
        self._is_made = True

    def _claim(self, claim: bytes) -> bool:
        self._bucket.put(_CLAIM, claim, is_new=True)
        return True

    def _unclaim(self, claim: bytes) -> None:
        with contextlib.suppress(StorageError):
            found = self._bucket.get(_CLAIM)
            # Another process may have the name by now.
            if found is not None and found.data == claim:
                self._bucket.delete([_CLAIM])

    def _has(self, apart_from: str = "") -> bool:
        folders, objects = self._bucket.children()
        return bool(folders or [item for item in objects if item.key != apart_from])

    def is_taken(self) -> bool:
        """Whether there is anything of a sweep here."""
        return side_by_side(_answer, [self._has, self._bucket.is_store])[0]

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

    def best_stamp(self) -> tuple[int, ...]:
        """Return what changes whenever a winner is written; empty: none has been."""
        return _stamp(self._bucket.look(f"{names.BEST_FOLDER}/{names.BEST_RECORD}"))

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
        listed = self._listed_trials()
        # Those whose present content this process knows are not fetched.
        side_by_side(lambda trial_id: self.trial(trial_id).fetch(listed[trial_id], results=False), listed)
        records = [self.trial(trial_id).read_record(item) for trial_id, item in listed.items()]
        return sorted(records, key=lambda record: record.index)

    def trial_stamps(self) -> dict[str, tuple[int, ...]]:
        """Return what changes whenever a trial's record is written, by id."""
        return {trial_id: _stamp(item) for trial_id, item in self._listed_trials().items()}

    def _listed_trials(self) -> dict[str, Listed]:
        try:
            listed = self._parts.listed_records()
        except StorageError as error:
            raise CheckpointError(error.message, error.hint) from error
        found = {key.removeprefix(f"{RECORDS}/").removesuffix(".json"): item for key, item in listed.items()}
        return {trial_id: item for trial_id, item in found.items() if is_trial_id(trial_id)}

    @contextlib.contextmanager
    def reading(self, *, results: bool = True, checkpoints: Sequence[CheckpointRecord] = ()) -> Iterator[None]:
        """Read much of all trials in the block: it is fetched at its beginning, many at once."""
        # It may be a part of a larger block, which need not have fetched all that this one wants.
        is_outermost, had_results = self._parts.snapshot is None, self._has_results
        if is_outermost:
            self._parts.snapshot = object()
        try:
            if is_outermost or (results and not had_results):
                self._has_results = results
                listed = self._listed_trials()
                side_by_side(lambda trial_id: self.trial(trial_id).fetch(listed[trial_id], results=results), listed)
            if checkpoints:
                pending: list[Future[Any]] = []
                with ThreadPoolExecutor(AT_ONCE) as pool:
                    for item in checkpoints:
                        fetch = self.trial(item.trial_id).fetch_checkpoint
                        pending.append(pool.submit(contextvars.copy_context().run, fetch, item.iteration))
                for future in pending:
                    future.result()
            yield
        finally:
            if is_outermost:
                self._parts.snapshot, self._has_results = None, False

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
        watch = watch_or_end(self.place)
        told = f"Sweep {self.name} is being run by another process."
        with (
            leased(self._bucket, _LOCK, told, watch, is_first=self._is_made) as beating,
            holding(self.url, beating.is_sure, is_new=beating.is_first),
        ):
            # It is taken for one that holds the other: nobody has.
            if not beating.is_first and is_leased(self._bucket, _DRIVER_LOCK, LEASE_S, believed_s=0.0):
                raise CannotRunError(*still_driven(self.name))
            self._parts.is_locked = beating.is_ours
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
        with leased(self._bucket, _DRIVER_LOCK, *still_driven(self.name)):
            yield

    def is_driven(self) -> bool:
        """Whether a process holds one of the locks."""
        return is_leased(self._bucket, _LOCK) or is_leased(self._bucket, _DRIVER_LOCK)

    def take(self) -> ObjectOwner:
        """Become the sweep's run: no process of an earlier run can take a trial or a pack any more."""
        self._parts.run = ObjectOwner.take(self._bucket, RUN)
        return self._parts.run

    def owner(self, token: str) -> ObjectOwner:
        """Return the run whose token another process has passed on."""
        self._parts.run = ObjectOwner(self._bucket, RUN, token)
        return self._parts.run

    def remove_leftovers(self) -> None:
        """Remove objects that killed processes left behind; the caller has to hold the lock."""
        ended = [trial.trial_id for trial in self.read_trials() if trial.status in FINISHED]
        # One listing of all costs fewer requests than two of each.
        prefixes = [f"{PROBE_FOLDER}/", *([f"{names.TRIALS_FOLDER}/"] if ended else [])]
        answers, *found = side_by_side(self._bucket.listed, prefixes)
        by_trial: dict[str, list[str]] = {}
        for item in itertools.chain.from_iterable(found):
            by_trial.setdefault(item.key.split("/", 2)[1], []).append(item.key)
        gone = side_by_side(lambda name: self.trial(name).leftovers(by_trial.get(name, [])), ended)
        self._bucket.delete([*(item.key for item in answers), *itertools.chain.from_iterable(gone)])

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


def _answer(ask: Callable[[], bool]) -> bool:
    return ask()


def name_taken(url: ObjectUrl) -> SpecError:
    """Return the error that a name is taken."""
    go_on = f"continue it: `tune-jobs resume {name_in_commands(str(url))}`"
    other = go_on if ObjectSweep(url).exists() else f"remove what is there: it has no {names.SWEEP_RECORD}"
    hint = f"Choose another name with --name, or {other}."
    return SpecError(f"A sweep {url.name!r} is already in {url.parent.short}.", hint)


def _stamp(item: Listed | None) -> tuple[int, ...]:
    if item is None:
        return ()
    digest = hashlib.sha256(repr(item.tag).encode()).digest()
    return int.from_bytes(digest[:8]), item.size, int(item.modified_s)

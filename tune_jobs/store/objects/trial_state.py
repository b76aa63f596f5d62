"""The state of a trial, as its head names it: read by anybody, and written in the background by the trial's owner.

A process has local files of it, in a folder of its own. Of a reader they are what it has fetched. Of a writer they are
the newest state, which `_upload` brings to the store: first new objects, then the head that names them, and then what
no head names any more is removed.
"""

from __future__ import annotations

import contextlib
import secrets
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from weakref import WeakMethod

from policies.errors import CannotRunError, CheckpointError
from tune_jobs.store import names
from tune_jobs.store.objects.at_once import side_by_side
from tune_jobs.store.objects.bucket import ConflictError, StorageError, Tag
from tune_jobs.store.objects.checkpoint_objects import CheckpointObjects
from tune_jobs.store.objects.copy_objects import CopyObjects
from tune_jobs.store.objects.head import NAMED, Chunk, Head, StoredCheckpoint, free, read_head, unnamed
from tune_jobs.store.objects.held import Held, held
from tune_jobs.store.objects.outbox import outbox
from tune_jobs.store.objects.owners import Epoch, lost
from tune_jobs.store.objects.parts import Parts
from tune_jobs.store.objects.result_chunks import NewChunk, ResultChunks
from tune_jobs.store.objects.scratch import make_local, write_local
from tune_jobs.store.trial_contract import Ownership
from tune_jobs.store.trial_store import TrialStore

_RESULTS_AFTER_S = 3.0
"""Seconds in which results are gathered, if no checkpoint is uploaded sooner."""
_CHECKPOINTS_AFTER_S = 2.0
"""Seconds in which another checkpoint may come, with which the first may be needed no more."""
_LOOK_EVERY_S = 1.0
_ATTEMPTS = 20


class TrialState:
    """Results and checkpoints of one trial.

    Args:
        parts: The sweep's objects.
        trial_id: The trial.
    """

    def __init__(self, parts: Parts, trial_id: str) -> None:
        self._parts, self._bucket, self._trial_id = parts, parts.bucket, trial_id
        self._prefix = f"{names.TRIALS_FOLDER}/{trial_id}"
        self._head_key = f"{self._prefix}/head.json"
        self._folder: Path | None = None
        self._writer = secrets.token_hex(4)
        # What the store has, as far as this process knows.
        self._head = Head()
        self._tag: Tag | None = None
        self._token: str | None = None
        self._is_lost, self._looked_at = False, -float("inf")
        self.is_writing = False
        """Whether the local files are the newest state."""
        self._is_first = False  # Whether this process is the first one that has ever taken the trial.
        # What this process has written, as names of local folders by iteration, and what is to be in the next head.
        self._checkpoints: dict[int, StoredCheckpoint | None] = {}
        self._keys: dict[int, str] = {}
        self._damaged: dict[str, str] = {}
        self._results: tuple[Chunk, ...] = ()
        self._has_results = False
        self._stored = CheckpointObjects(self._bucket, self._prefix)
        self._chunks = ResultChunks(self._bucket, self._prefix)
        self.copies = CopyObjects(self._bucket, self._prefix, WeakMethod(self.folder))
        self._lock = threading.RLock()
        # What the head and the local results are as of, while much is read.
        self._head_of: object | None = None
        self.is_over = False
        """Whether the trial was completed when the head was asked for, so that nobody writes it any more."""
        self._last_for: Held | None = None
        self._results_of: object | None = None

    # -- who writes

    def take(self, under: Ownership | None) -> None:
        """Become the owner; see `Trial.take`."""
        outbox().forget([self._job])
        for _ in range(_ATTEMPTS):
            # An owner of before, who is refused here, is one that was replaced before this call.
            asked: list[Callable[[], tuple[Head, Tag | None] | None]] = [
                lambda: read_head(self._bucket, self._head_key)
            ]
            if under is not None:
                asked.append(under.check)
            head, tag = side_by_side(lambda ask: ask(), asked)[0] or (Head(), None)
            epoch = Epoch.of(head.owner).next(under.token if under is not None else None, self._name)
            token = epoch.token()
            new = head.model_copy(update={"owner": token, "sequence": head.sequence + 1})
            try:
                new_tag = self._put(new, tag)
            except ConflictError:
                continue
            with self._lock:
                self._token, self._is_lost, self._looked_at = token, False, time.monotonic()
                self._is_first = tag is None
                self._begin_writing(new, new_tag)
            return
        raise CannotRunError(f"{self._name} is taken by one after the other.", "End those that drive this sweep.")

    def _begin_writing(self, head: Head, tag: Tag | None) -> None:
        # Until all is here, what is here is not the newest state, and must not be written as if it were.
        self._head, self._tag, self.is_writing = head, tag, False
        self._checkpoints = dict(head.checkpoints)
        self._damaged, self._results, self._has_results = dict(head.damaged), head.results, head.has_results
        self._keys.clear()
        shutil.rmtree(self.folder(), ignore_errors=True)
        if not self._write_results(head):
            raise self._lacks_results()
        self.is_writing = True

    def check(self) -> None:
        """Raise an error if another process has become the owner, as far as is known."""
        if self._is_lost:
            raise lost(self._name)

    def begin(self) -> None:
        """Begin to write, if this has not; from then on, the local files are the newest state.

        Raises:
            OwnershipLostError: Another process has become the owner, as far as is known.
        """
        self.check()
        if not self.is_writing:
            with self._lock:
                self._begin_writing(*read_head(self._bucket, self._head_key))

    @property
    def is_taken(self) -> bool:
        """Whether this process has taken the trial."""
        return self._token is not None

    def is_lost(self) -> bool:
        """Whether this process has taken the trial, and another one has taken it since."""
        if self._token is not None and not self._is_lost and time.monotonic() - self._looked_at > _LOOK_EVERY_S:
            head, _ = read_head(self._bucket, self._head_key)
            self._looked_at = time.monotonic()
            self._is_lost = head.owner != self._token
        return self._is_lost

    def settle(self) -> None:
        """Wait until what was written is in the store.

        Raises:
            OwnershipLostError: Another process has taken the trial.
            CannotRunError: It cannot be written.
        """
        outbox().settle([self._job])

    # -- what is read

    def folder(self) -> Path:
        """Return the local folder of the trial, in one of this process."""
        if self._folder is None:
            self._folder = self._parts.own() / secrets.token_hex(4)
        return self._folder / names.TRIALS_FOLDER / self._trial_id

    @property
    def _results_path(self) -> Path:
        return self.folder() / names.RESULTS

    def local(self) -> TrialStore:
        """Return the local files of the trial, with the results that there are now."""
        if not self.is_writing:
            self._look()
        make_local(self.folder())
        return TrialStore(self.folder().parent.parent, self._trial_id)

    def has_results(self) -> bool:
        """Whether any results have been written."""
        return self._has_results if self.is_writing else self._look_head().has_results

    def checkpoints(self) -> Mapping[int, StoredCheckpoint | None]:
        """Return the checkpoints by iteration; None stands for one that is not in the store yet."""
        return dict(self._checkpoints) if self.is_writing else self._look_head().checkpoints

    def latest_damaged(self) -> int:
        """Return the latest iteration of a checkpoint that was set aside; 0 if there is none."""
        damaged = self._damaged if self.is_writing else self._look_head().damaged
        return max((int(name.partition("-")[0]) for name in damaged if name[:6].isdecimal()), default=0)

    def manifest_folder(self, iteration: int) -> Path:
        """Return a local folder with a checkpoint's manifest; the other files need not be there."""
        return self._with_manifest(iteration, self.checkpoints().get(iteration))

    def _with_manifest(self, iteration: int, stored: StoredCheckpoint | None) -> Path:
        folder = self._local_checkpoint(iteration, stored)
        if stored is not None and not (folder / names.MANIFEST).exists():
            write_local(folder / names.MANIFEST, stored.manifest)
        return folder

    def checkpoint_folder(self, iteration: int) -> Path:
        """Return a local folder with a checkpoint's files; it does not exist if there is no such checkpoint."""
        stored = self.checkpoints().get(iteration)
        folder = self._with_manifest(iteration, stored)
        if stored is not None and self._keys.get(iteration) != stored.key:
            self._stored.fetch(iteration, stored, folder)
        return folder

    def _local_checkpoint(self, iteration: int, stored: StoredCheckpoint | None) -> Path:
        if stored is None or self._keys.get(iteration) == stored.key:
            return self.folder() / names.CHECKPOINTS_FOLDER / f"{iteration:06d}"
        return self.folder() / "fetched" / stored.key / f"{iteration:06d}"

    def _look_head(self) -> Head:
        as_of, ours = self._parts.snapshot, held(self._bucket.url)
        is_known = ours is not None and ours.is_known
        if is_known and ours is self._last_for:
            # Only who has the sweep's lock could let somebody write it again.
            self._head_of = as_of
        elif as_of is None or as_of is not self._head_of:
            self._head, self._tag = read_head(self._bucket, self._head_key)
            self._head_of, self._last_for = as_of, ours if is_known and self.is_over else None
        return self._head

    def _look(self) -> None:
        """Bring the local results to what the store has."""
        # Two threads that look at once would both append what is new.
        with self._lock:
            as_of = self._parts.snapshot
            if as_of is not None and as_of is self._results_of:
                return
            for _ in range(_ATTEMPTS):
                if self._write_results(self._look_head()):
                    self._results_of = as_of
                    return
                # An object went while it was fetched, as there is a newer head.
                self._head_of = None
        raise self._lacks_results()

    def _lacks_results(self) -> CheckpointError:
        message = f"{self._name} names results that do not exist."
        return CheckpointError(message, "Restore the objects, or an earlier version of the head.")

    def _write_results(self, head: Head) -> bool:
        if head.has_results:
            return self._chunks.read(head.results, self._results_path)
        self._results_path.unlink(missing_ok=True)
        return True

    # -- what is written

    @property
    def _name(self) -> str:
        return self._bucket.name_of(self._prefix)

    @property
    def _job(self) -> tuple[str, str]:
        return self._name, self._writer

    def changed(self, *, has_results: bool = False, after_s: float = _RESULTS_AFTER_S) -> None:
        """Have the state uploaded."""
        self._has_results = self._has_results or has_results
        self._parts.jobs.add(self._job)
        outbox().add(self._job, self._upload, after_s=after_s)

    @contextlib.contextmanager
    def replacing_results(self) -> Iterator[None]:
        """Replace the local results in the block, and have them uploaded after it."""
        with self._lock:
            self._chunks.forget_file()
            yield
        self.changed(has_results=True)

    def wrote_checkpoint(self, iteration: int) -> None:
        """Have a checkpoint uploaded that is in its local folder."""
        with self._lock:
            self._checkpoints[iteration] = None
            self._keys[iteration] = secrets.token_hex(8)
        self.changed(after_s=_CHECKPOINTS_AFTER_S)

    def remove_checkpoint(self, iteration: int) -> None:
        """Leave a checkpoint out of the state."""
        with self._lock:
            stored = self._checkpoints.pop(iteration)
            shutil.rmtree(self._local_checkpoint(iteration, stored), ignore_errors=True)
            self._keys.pop(iteration, None)
        self.changed()

    def set_aside(self, iteration: int) -> str:
        """Take a damaged checkpoint out of the state, and return its name among what is damaged."""
        # Set aside is kept: what is not in the store yet is brought there first.
        self.settle()
        with self._lock:
            stored = self._checkpoints.pop(iteration, None)
            name = free(f"{iteration:06d}", self._damaged)
            if stored is not None:
                self._damaged[name] = stored.key
        self.changed(after_s=0.0)
        return name

    def set_aside_results(self) -> str:
        """Take all results out of the state, and return their name among what is damaged."""
        self.settle()
        with self._lock:
            name = free(names.RESULTS, self._damaged)
            self._damaged[name] = " ".join(chunk.key for chunk in self._results)
            self._results, self._has_results = (), False
            self._results_path.unlink(missing_ok=True)
        self.changed(after_s=0.0)
        return name

    def _upload(self) -> None:
        self.check()
        with self._lock:
            wanted, keys, damaged = dict(self._checkpoints), dict(self._keys), dict(self._damaged)
            has_results, noted = self._has_results, self.copies.noted
            results, new = self._chunks.divide(self._results_path, self._results) if has_results else ((), None)
        stored = self._upload_objects(wanted, keys, new)
        head = self._head.model_copy(
            update={
                "owner": self._token if self._token is not None else self._head.owner,
                "sequence": self._head.sequence + 1,
                "has_results": has_results,
                "results": results,
                "checkpoints": stored,
                "damaged": damaged,
            }
        )
        before = self._head
        self._commit(head)
        with self._lock:
            self._results = results
            for iteration, checkpoint in stored.items():
                if iteration in self._checkpoints and self._keys.get(iteration, checkpoint.key) == checkpoint.key:
                    self._checkpoints[iteration] = checkpoint
        self._remove_unnamed(before, head)
        self.copies.remove_replaced(noted, max(stored, default=0))

    def _upload_objects(
        self, wanted: Mapping[int, StoredCheckpoint | None], keys: Mapping[int, str], last: NewChunk | None
    ) -> dict[int, StoredCheckpoint]:
        """Upload what the store lacks, side by side, and return all checkpoints for the head."""
        new = [iteration for iteration, stored in sorted(wanted.items()) if stored is None]

        def upload(iteration: int | None) -> StoredCheckpoint | None:
            if iteration is not None:
                return self._upload_checkpoint(iteration, keys[iteration])
            if last is not None:
                self._chunks.upload(last, self._results_path)
            return None

        # The first is done by this thread, so that the files of a single checkpoint are side by side, too.
        uploaded = dict(zip(new, side_by_side(upload, [*new, None]), strict=False))
        found = {iteration: stored or uploaded[iteration] for iteration, stored in sorted(wanted.items())}
        return {iteration: stored for iteration, stored in found.items() if stored is not None}

    def _commit(self, head: Head) -> None:
        try:
            self._tag = self._put(head, self._tag)
        except ConflictError:
            present, tag = read_head(self._bucket, self._head_key)
            if self._token is None or present.owner != self._token:
                self._is_lost = True
                raise lost(self._name, present.owner) from None
            # This process wrote it, and the answer was lost.
            self._tag = self._put(head.model_copy(update={"sequence": present.sequence + 1}), tag)
        self._head = head

    def _put(self, head: Head, tag: Tag | None) -> Tag:
        data = head.model_dump_json().encode()
        return self._bucket.put(self._head_key, data, over=tag, is_new=tag is None)

    def _upload_checkpoint(self, iteration: int, key: str) -> StoredCheckpoint | None:
        """Upload a checkpoint's files; None: it was removed meanwhile."""
        folder = self.folder() / names.CHECKPOINTS_FOLDER / f"{iteration:06d}"
        try:
            # It may be replaced meanwhile; the next try finds the other one.
            return self._stored.upload(iteration, key, folder)
        except (FileNotFoundError, CheckpointError) as error:
            if iteration in self._checkpoints and self._keys.get(iteration) == key:
                raise StorageError(f"Checkpoint {iteration} of {self._name} is gone: {error}.", passes=True) from error
            return None

    def _remove_unnamed(self, before: Head, now: Head) -> None:
        """Remove the objects that one head named, and no head names any more."""
        named = now.named()
        gone = self._chunks.forget({chunk.key for chunk in before.results} - named, self._results_path)
        gone += self._stored.keys_of(before.checkpoints, named)
        # Nobody waits for it: what is not removed is a leftover.
        self._parts.remove_later(gone)

    def remove_leftovers(self) -> None:
        """Remove objects that no head names: those of a process that ended before it wrote its head."""
        if not self._is_first:
            present = side_by_side(self._bucket.listed, [f"{self._prefix}/{folder}/" for folder in NAMED])
            self._bucket.delete(self.leftovers([item.key for items in present for item in items]))

    def leftovers(self, present: Sequence[str]) -> list[str]:
        """Return those of the trial's objects, which were listed before this call, that no head names."""
        head = self._head if self.is_writing else self._look_head()
        return unnamed(self._prefix, present, head.named() | set(self._keys.values()))

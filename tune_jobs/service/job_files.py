"""The files of a job beside the sweeps: who runs it, and how it ended.

A driver lives on when the service is killed, so the service can't wait for it as a parent does. What is known of it is
in files: a lock that the system frees when the driver ends, however it ends, and the outcome that it wrote before.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Collection
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from policies.errors import CannotRunError
from policies.files import write_atomic
from tune_jobs.store.locks import is_held

SERVICE_FOLDER = ".service"
"""In the storage folder; hidden, so that it is no sweep."""
KEPT_S = 7 * 24 * 3_600.0
"""How long what the driver of a job that failed has printed is kept, in seconds."""


def own_folder(root: Path) -> Path:
    """Return the folder for what the service writes of its own, in the folder that sweeps are in."""
    return root / SERVICE_FOLDER


def own_database(folder: Path) -> Path:
    """Return the file of the service's database, where no other is given, in its own folder."""
    return folder / "service.db"


class Ended(BaseModel):
    """How an attempt at a job ended."""

    model_config = ConfigDict(frozen=True)

    attempt: int
    outcome: Literal["completed", "failed", "stopped", "interrupted"]
    """Stopped: somebody asked the sweep to stop. Interrupted: a signal came, such as when the service is drained, or
    the program's files were changed meanwhile; it goes on later."""
    message: str | None = None
    finish_failed: bool | None = None
    """Whether what follows the trials failed; None: they did not come to their end."""


class Holder(BaseModel):
    """A driver that runs a job."""

    model_config = ConfigDict(frozen=True)

    pid: int
    sweep: str


def remove_ended(folder: Path, open_uids: Collection[str], now: float) -> None:
    """Remove the files of jobs that have ended, as far as nobody needs them any more.

    What drivers printed is kept for `KEPT_S`: whoever wants to know why a job failed reads it. Nothing is left of jobs
    that ended well, unless the service was killed meanwhile.

    Args:
        folder: The service's folder.
        open_uids: The jobs that have not ended.
        now: Seconds since 1970.
    """
    for path in (folder / "jobs").glob("*"):
        # A driver may run a job that no database knows any more.
        if path.stem in open_uids or JobFiles(folder, path.stem).is_run():
            continue
        with contextlib.suppress(OSError):
            if path.suffix in (".held", ".json") or (path.suffix == ".log" and path.stat().st_mtime < now - KEPT_S):
                path.unlink()


def begun_jobs(folder: Path) -> list[JobFiles]:
    """Return the files of those jobs that a driver runs, or ran."""
    return [JobFiles(folder, path.stem) for path in sorted((folder / "jobs").glob("*.held"))]


def held_jobs(folder: Path) -> list[Holder]:
    """Return the drivers that run now, as the files of all jobs say."""
    holders = (files.holder() for files in begun_jobs(folder))
    return [holder for holder in holders if holder is not None]


class JobFiles:
    """The files of one job.

    Args:
        folder: The service's folder.
        uid: The job's random name: ids begin anew where the database was lost.
    """

    def __init__(self, folder: Path, uid: str) -> None:
        self.uid = uid
        self._folder = folder / "jobs"
        self._lock = self._folder / f"{uid}.held"
        self._ended = self._folder / f"{uid}.json"
        self.log = self._folder / f"{uid}.log"
        """What the driver process prints besides the sweep's own log."""

    def take(self) -> int | None:
        """Return a descriptor that holds the job's lock until each copy of it is closed; None: a driver holds it.

        Raises:
            CannotRunError: The folder can't be written.
        """
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self._lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        except OSError as error:
            raise CannotRunError(
                f"The service can't write {self._lock}: {error.strerror}.", "Check the storage folder."
            ) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(descriptor)
            return None
        # The last driver's id may be any process's by now, the first one's of this container too.
        os.ftruncate(descriptor, 0)
        return descriptor

    def is_run(self) -> bool:
        """Whether a driver runs the job now."""
        return is_held(self._lock)

    def say_who(self, who: Holder) -> None:
        """Write into the lock who holds it."""
        self._lock.write_text(who.model_dump_json(), encoding="utf-8")

    def holder(self) -> Holder | None:
        """Return the driver that runs the job; None: none does, or it has not yet said who it is."""
        if not self.is_run():
            return None
        try:
            return Holder.model_validate_json(self._lock.read_bytes())
        except (OSError, ValidationError):
            return None

    def is_open_in(self, pid: int) -> bool:
        """Whether a process of this id has the lock open: in a container, ids are others than outside of it.

        Where the system does not say what a process has open, this is true.
        """
        try:
            lock = self._lock.stat()
            if not Path("/proc/self/fd").exists():
                return True
            for path in Path(f"/proc/{pid}/fd").iterdir():
                with contextlib.suppress(OSError):
                    if os.path.samestat(path.stat(), lock):
                        return True
        except OSError:  # it has ended, or is another user's
            pass
        return False

    def write_ended(self, ended: Ended) -> None:
        """Write how an attempt ended."""
        write_atomic(self._ended, ended.model_dump_json())

    def read_ended(self, attempt: int) -> Ended | None:
        """Return how an attempt ended; None: it has not, or its process died before it could say."""
        ended = self._last_ended()
        return ended if ended is not None and ended.attempt == attempt else None

    def num_deaths(self, num_attempts: int) -> int:
        """Return how many processes died one after the other, the last of so many attempts among them.

        An attempt that ended in order, as when the service was drained, is none, and those before it are over.
        """
        ended = self._last_ended()
        return num_attempts - (0 if ended is None else ended.attempt)

    def _last_ended(self) -> Ended | None:
        try:
            return Ended.model_validate_json(self._ended.read_bytes())
        except (OSError, ValidationError):
            return None

    def last_lines(self, count: int = 20) -> str:
        """Return the end of what the driver printed."""
        with contextlib.suppress(OSError), self.log.open("rb") as file:
            file.seek(max(0, self.log.stat().st_size - 10_000))
            return "\n".join(file.read().decode("utf-8", "replace").splitlines()[-count:])
        return ""

    def remove(self) -> None:
        """Remove the files of a job that has ended."""
        for path in (self._ended, self.log, self._lock):
            # What can't be removed now is removed at the next start.
            with contextlib.suppress(OSError):
                path.unlink()

"""What people say of sweeps: whose they are, a note, tags."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Engine, RowMapping, delete, func, insert, or_, select, update
from sqlalchemy.exc import IntegrityError

from policies.errors import TuneJobsError
from tune_jobs.service.database.tables import sweeps
from tune_jobs.service.jobs import Job
from tune_jobs.service.queue import Queue
from tune_jobs.service.storage_health import is_of_store
from tune_jobs.store.contract import Storage
from tune_jobs.store.patience import impatient

_SAME_S = 1e-3
"""Two sweeps of one name are created further apart; a database may round."""


@dataclass(frozen=True)
class Label:
    """What is said of one sweep."""

    owner: str | None = None
    note: str = ""
    tags: tuple[str, ...] = ()
    created_at: float | None = None
    """When that sweep was created; None: an earlier version wrote it, which did not say, and `date` has not yet."""

    def of(self, created_at: float) -> Label:
        """Return what counts of it for the sweep that has the name now: nothing if it was said of another one."""
        if self.created_at is not None and abs(self.created_at - created_at) > _SAME_S:
            return NOTHING
        return self


NOTHING = Label()


class Labels:
    """The labels in a database, by the names of sweeps; a sweep may be gone, and its name another one's.

    Args:
        engine: The database.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def all(self) -> dict[str, Label]:
        """Return the labels by sweep."""
        with self._engine.begin() as connection:
            rows = connection.execute(select(sweeps)).mappings().all()
        return {row["name"]: _label(row) for row in rows}

    def of(self, name: str) -> Label:
        """Return the label of one sweep."""
        with self._engine.begin() as connection:
            row = connection.execute(select(sweeps).where(sweeps.c.name == name)).mappings().first()
        return NOTHING if row is None else _label(row)

    def change(
        self,
        name: str,
        *,
        owner: str | None = None,
        note: str | None = None,
        tags: Sequence[str] | None = None,
        created_at: float | None = None,
    ) -> Label:
        """Change what is given, and return the label.

        Args:
            name: The sweep.
            owner: Whose it is.
            note: A note.
            tags: Tags.
            created_at: When the sweep was created: what is said of another one of the name is forgotten. None: it is
                changed, whichever it is said of.
        """
        given: dict[str, Any] = {
            "owner": owner, "note": note, "tags": None if tags is None else list(tags), "created_at": created_at,
        }  # fmt: skip
        values = {key: value for key, value in given.items() if value is not None}
        change = update(sweeps).where(sweeps.c.name == name).values(values or {"name": name})
        with self._engine.begin() as connection:
            if created_at is not None:
                is_of_another = func.abs(sweeps.c.created_at - created_at) > _SAME_S
                connection.execute(delete(sweeps).where(sweeps.c.name == name, is_of_another))
            if connection.execute(change).rowcount == 0:
                try:
                    # Of PostgreSQL's transactions an error would end the whole one.
                    with connection.begin_nested():
                        new = {"name": name, "owner": "", "note": "", "tags": []} | values
                        connection.execute(insert(sweeps).values(new))
                except IntegrityError:
                    # Another one has made it meanwhile, and said something else of it.
                    connection.execute(change)
        return self.of(name)

    def forget(self, name: str, created_at: float | None = None) -> None:
        """Forget a sweep that is deleted.

        Args:
            name: The sweep.
            created_at: When it was created: what is said of a later one of the name stays. None: nothing does.
        """
        forgotten = delete(sweeps).where(sweeps.c.name == name)
        if created_at is not None:
            is_later = sweeps.c.created_at > created_at + _SAME_S
            forgotten = forgotten.where(or_(sweeps.c.created_at.is_(None), ~is_later))
        with self._engine.begin() as connection:
            connection.execute(forgotten)

    def date(self, found: Mapping[str, float | None]) -> None:
        """Say of labels that do not say so of which sweep they are.

        Args:
            found: When each one's sweep was created; None: it is no more, and its label is forgotten.
        """
        with self._engine.begin() as connection:
            for name, created_at in found.items():
                change = delete(sweeps) if created_at is None else update(sweeps).values(created_at=created_at)
                connection.execute(change.where(sweeps.c.name == name, sweeps.c.created_at.is_(None)))


def date_labels(labels: Labels, queue: Queue, storage: Storage) -> None:
    """Say of labels that an earlier version wrote of which sweep they are, as the sweeps' jobs tell it.

    What can't be read now is left for the next start. Where all are dated, as after the first start, this reads no
    sweep.
    """
    undated = [name for name, label in labels.all().items() if label.created_at is None]
    if not undated:
        return
    jobs: dict[str, list[Job]] = {}
    for job in queue.jobs():
        jobs.setdefault(job.sweep, []).append(job)
    found: dict[str, float | None] = {}
    with impatient():
        for name in undated:
            try:
                created_at = storage.sweep(name).read_record().created_at
            except TuneJobsError as error:
                if is_of_store(storage, error):
                    break
                continue
            found[name] = None if _was_removed(jobs.get(name, []), created_at) else created_at
    labels.date(found)


def _was_removed(jobs: Sequence[Job], created_at: float) -> bool:
    """Whether a sweep of the name had jobs before, and the one that has it now was not submitted."""
    present = [job for job in jobs if not job.is_of_former(created_at)]
    # One that is submitted has its job first; a later job may be of whoever resumes it, or of a start that finds it.
    was_submitted = any(job.submitted_at <= created_at for job in present)
    return len(present) < len(jobs) and not was_submitted


def _label(row: RowMapping) -> Label:
    return Label(row["owner"] or None, row["note"], tuple(row["tags"]), row["created_at"])

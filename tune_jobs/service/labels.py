"""What people say of sweeps: whose they are, a note, tags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Engine, delete, insert, select, update
from sqlalchemy.exc import IntegrityError

from tune_jobs.service.database.tables import sweeps


@dataclass(frozen=True)
class Label:
    """What is said of one sweep."""

    owner: str | None = None
    note: str = ""
    tags: tuple[str, ...] = ()


NOTHING = Label()


class Labels:
    """The labels in a database.

    Args:
        engine: The database.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def all(self) -> dict[str, Label]:
        """Return the labels by sweep."""
        with self._engine.begin() as connection:
            rows = connection.execute(select(sweeps)).mappings().all()
        return {row["name"]: Label(row["owner"] or None, row["note"], tuple(row["tags"])) for row in rows}

    def of(self, name: str) -> Label:
        """Return the label of one sweep."""
        with self._engine.begin() as connection:
            row = connection.execute(select(sweeps).where(sweeps.c.name == name)).mappings().first()
        return NOTHING if row is None else Label(row["owner"] or None, row["note"], tuple(row["tags"]))

    def change(
        self, name: str, *, owner: str | None = None, note: str | None = None, tags: Sequence[str] | None = None
    ) -> Label:
        """Change what is given, and return the label."""
        given: dict[str, Any] = {"owner": owner, "note": note, "tags": None if tags is None else list(tags)}
        values = {key: value for key, value in given.items() if value is not None}
        change = update(sweeps).where(sweeps.c.name == name).values(values or {"name": name})
        with self._engine.begin() as connection:
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

    def forget(self, name: str) -> None:
        """Forget a sweep that is deleted."""
        with self._engine.begin() as connection:
            connection.execute(delete(sweeps).where(sweeps.c.name == name))

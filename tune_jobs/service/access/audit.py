"""The audit log: who changed what, and what the answer was."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import Engine, delete, insert, select
from sqlalchemy.exc import SQLAlchemyError

from policies.errors import SpecError, fit
from tune_jobs.service.database.tables import audit

_AT_ONCE = 5_000
_log = logging.getLogger(__name__)


class Entry(BaseModel):
    """One line of the audit log."""

    model_config = ConfigDict(frozen=True, from_attributes=True)

    id: int = Field(description="Number of the entry, in the order in which they came.")
    at: float = Field(description="When, in seconds since 1970.")
    who: str = Field(description="The token's name, or local; empty: nobody that is known.")
    client: str = Field(description="The client's address; empty: a command on the service's machine.")
    action: str = Field(description="What was asked for, such as submit, stop, login or token make.")
    target: str = Field(description="The sweep, if it is about one.")
    status: int = Field(description="The HTTP status of the answer; of a command 200.")
    details: dict[str, Any] = Field(description="More, such as the token's id.")


@dataclass(frozen=True)
class Done:
    """What is written down of a request."""

    who: str
    client: str
    action: str
    target: str
    status: int
    details: Mapping[str, Any]


class Audit:
    """The audit log in a database.

    Args:
        engine: The database.
        now: Returns the time in seconds since 1970.
    """

    def __init__(self, engine: Engine, now: Callable[[], float] = time.time) -> None:
        self._engine, self._now = engine, now

    def write(self, done: Done) -> None:
        """Write a line; where the database can't take it, it is in the service's own log.

        What was done is done: an answer that says otherwise would have it done twice.
        """
        values = {
            "at": self._now(), "who": _cut(done.who, 100), "client": _cut(done.client, 100),
            "action": _cut(done.action, 50), "target": _cut(done.target, 200), "status": done.status,
            "details": {name: _cut(str(value), 200) for name, value in done.details.items()},
        }  # fmt: skip
        try:
            with self._engine.begin() as connection:
                connection.execute(insert(audit).values(values))
        except SQLAlchemyError as error:
            _log.error("The audit log can't be written (%s). It lacks %r.", type(error).__name__, values)

    def remove_older(self, age_s: float, limit: int = _AT_ONCE) -> int:
        """Remove the oldest entries of those that are older than this, in seconds; return how many were removed."""
        old = select(audit.c.id).where(audit.c.at < self._now() - age_s).order_by(audit.c.id).limit(limit)
        with self._engine.begin() as connection:
            return connection.execute(delete(audit).where(audit.c.id.in_(old))).rowcount

    def page(
        self, *, limit: int, cursor: str | None = None, who: str | None = None, target: str | None = None
    ) -> tuple[list[Entry], str | None]:
        """Return the last entries, the newest first, and the cursor of those before them.

        Args:
            limit: The most entries.
            cursor: That of the page before; None: the first page.
            who: Only this person's.
            target: Only those about this sweep.

        Raises:
            SpecError: The cursor is not one of this list.
        """
        wanted = select(audit).order_by(audit.c.id.desc()).limit(limit + 1)
        if cursor is not None:
            if not (cursor.isascii() and cursor.isdecimal() and len(cursor) <= 18):
                raise SpecError(
                    "cursor: this is no cursor of this list.", "Take `next_cursor` of the page before, unchanged."
                )
            wanted = wanted.where(audit.c.id < int(cursor))
        if who is not None:
            wanted = wanted.where(audit.c.who == who)
        if target is not None:
            wanted = wanted.where(audit.c.target == target)
        with self._engine.begin() as connection:
            rows = connection.execute(wanted).mappings().all()
        entries = [Entry.model_validate(dict(row)) for row in rows[:limit]]
        return entries, str(entries[-1].id) if len(rows) > limit else None


def _cut(text: str, length: int) -> str:
    return fit(text)[:length]

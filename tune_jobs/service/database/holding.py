"""Hold a database for one service: a second one would take the first one's jobs for its own, and end them."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import time
from collections.abc import Iterator
from pathlib import Path

from sqlalchemy import Connection, Engine, text
from sqlalchemy.exc import SQLAlchemyError

from policies.errors import CannotRunError
from tune_jobs.service.database.opening import reason_of
from tune_jobs.service.ending import END_S, within

_log = logging.getLogger(__name__)
_KEY = 0x74756E652D6A6F62
"""Of PostgreSQL's advisory lock; each database has its own."""
_PATIENCE_S = 5.0
"""How long one waits at the start: a server notices a little late that a service was killed."""
_SETTINGS = ("tcp_keepalives_idle = 15", "tcp_keepalives_interval = 5", "tcp_keepalives_count = 3")
"""The server frees the lock of a machine that is gone after half a minute, and not after two hours."""


class Hold:
    """A database that is this service's; one thread at a time may use it.

    Args:
        engine: The database.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._connection: Connection | None = None

    def check(self) -> None:
        """Check that the database is still held, and take it again where its connection was lost.

        Raises:
            CannotRunError: Another service has taken it meanwhile.
            SQLAlchemyError: It can't be used.
        """
        if self._engine.dialect.name != "postgresql":
            # What holds a file is lost with the process alone.
            return
        try:
            if self._connection is None:
                self._take()
            else:
                self._connection.execute(text("SELECT 1"))
        except BaseException:
            self.close()
            raise

    def _take(self) -> None:
        connection = self._connection = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
        # No other call gets it, and it is closed at the end, not kept.
        connection.detach()
        for setting in _SETTINGS:
            connection.execute(text(f"SET {setting}"))
        if not connection.execute(text("SELECT pg_try_advisory_lock(:key)"), {"key": _KEY}).scalar():
            raise _taken(self._engine)

    def close(self) -> None:
        """Let it go."""
        connection, self._connection = self._connection, None
        if connection is not None:
            with contextlib.suppress(SQLAlchemyError):
                connection.close()


@contextlib.contextmanager
def held(engine: Engine) -> Iterator[Hold]:
    """Hold a database for the block.

    Args:
        engine: The database.

    Raises:
        CannotRunError: Another service has it, or it can't be used.
    """
    hold = Hold(engine)
    try:
        with _file_held(engine):
            _wait_for(hold)
            yield hold
    finally:
        # Where the thread of the queue still waits for an answer over its connection, closing waits for that, too; the
        # server frees the lock as the process ends.
        with contextlib.suppress(CannotRunError):
            within(hold.close, END_S)


def _wait_for(hold: Hold) -> None:
    deadline = time.monotonic() + _PATIENCE_S
    while True:
        try:
            return hold.check()
        except SQLAlchemyError as error:
            raise CannotRunError(
                f"The service's database can't be used: {reason_of(error)}.", "Check that it is there, and try again."
            ) from error
        except CannotRunError:
            if time.monotonic() > deadline:
                raise
        time.sleep(0.1)


@contextlib.contextmanager
def _file_held(engine: Engine) -> Iterator[None]:
    file = engine.url.database
    if engine.dialect.name != "sqlite" or file in (None, "", ":memory:"):
        yield
        return
    # However the file is named, it has one lock; not the file itself, which SQLite locks in its own way.
    lock = f"{Path(str(file)).resolve()}.held"
    try:
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise CannotRunError(
            f"The service can't write {lock}: {error.strerror}.", "Check the folder of the database."
        ) from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise _taken(engine) from error
        except OSError as error:
            _log.warning("%s can't be locked (%s): let no other service use the database.", lock, error.strerror)
        yield
    finally:
        os.close(descriptor)


def _taken(engine: Engine) -> CannotRunError:
    return CannotRunError(
        f"Another service uses the database {engine.url.render_as_string(hide_password=True)}.",
        "Give each service a database of its own.",
    )

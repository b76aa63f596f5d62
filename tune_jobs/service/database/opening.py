"""Open the service's database, and bring it to this version."""

from __future__ import annotations

import contextlib
import logging
import sqlite3
from pathlib import Path
from typing import Any
from urllib.parse import quote, quote_plus, unquote

from alembic import command
from alembic.config import Config
from alembic.script import ScriptDirectory
from alembic.util.exc import CommandError
from sqlalchemy import URL, Engine, create_engine, event, inspect, text
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from policies.errors import CannotRunError
from tune_jobs.service.logs import Redaction

BUSY_TIMEOUT_S = 10.0
"""How long a call waits for another process that writes."""
TURN_TIMEOUT_S = 20.0
"""How long a thread waits for its turn at a file that others of its process use."""
_PATIENCE = {
    "connect_timeout": 10, "keepalives_idle": 15, "keepalives_interval": 5, "keepalives_count": 3,
    "tcp_user_timeout": 20_000,
}  # fmt: skip
"""What libpq gets where the URL doesn't say: a server that is gone is noticed within half a minute, not a quarter of an
hour. All in seconds, but the last in milliseconds."""
_LIBPQ = ("postgresql+psycopg", "postgresql+psycopg2")
_MIGRATIONS = Path(__file__).with_name("migrations")


def sqlite_url(file: Path) -> str:
    """Return the URL of an SQLite database in a file of any name, as `open_database` reads it."""
    return f"sqlite:///{str(file).replace('%', '%25').replace('?', '%3F')}"


def _parsed(url: str) -> URL:
    """Return a URL in its parts, in which a file's name may have `?` as `%3F`, and `%` as `%25`."""
    parsed = make_url(url)
    # Before version 2.1, SQLAlchemy takes the name of a file as it is written.
    is_decoded = make_url("sqlite:///%25").database == "%"
    if is_decoded or parsed.get_backend_name() != "sqlite" or parsed.database is None:
        return parsed
    return parsed.set(database=unquote(parsed.database))


def password_in(url: str) -> tuple[str, ...]:
    """Return the password of a database's URL, as it is and as the URL has it; nothing where there is none."""
    try:
        password = make_url(url).password
    except (ArgumentError, ValueError):
        return ()
    return () if password is None else (str(password), quote(str(password), safe=" +"), quote_plus(str(password)))


def open_database(url: str) -> Engine:
    """Open a database, make its tables if it is new, and migrate it if it is of an older version.

    Args:
        url: `sqlite:///FILE`, with `?` as `%3F` and `%` as `%25`, or `postgresql://USER@HOST/NAME`.

    Raises:
        CannotRunError: The URL is wrong, or the database can't be reached, is damaged or of a newer version.
    """
    try:
        parsed = _parsed(url)
        if parsed.drivername in ("postgresql", "postgres"):
            parsed = parsed.set(drivername="postgresql+psycopg")
        told = parsed.render_as_string(hide_password=True)
        if parsed.get_backend_name() not in ("sqlite", "postgresql"):
            raise CannotRunError(
                f"{told}: the service keeps its queue in SQLite or PostgreSQL, not in {parsed.get_backend_name()}.",
                "Give sqlite:///FILE or postgresql://USER@HOST/NAME.",
            )
        # SQLite lets one transaction at a time write, and whoever waits for it looks now and then, and may find it
        # taken each time: threads of this process queue for one connection instead.
        one: dict[str, Any] = {"pool_size": 1, "max_overflow": 0, "pool_timeout": TURN_TIMEOUT_S}
        settings = one if _is_in_file(parsed) else {"connect_args": _patience(parsed)}
        engine = create_engine(parsed, pool_pre_ping=True, hide_parameters=True, **settings)
    except (ArgumentError, NoSuchModuleError, ValueError) as error:
        raise CannotRunError(
            f"{Redaction()(url)!r} is no database URL.", "Give sqlite:///FILE or postgresql://USER@HOST/NAME."
        ) from error
    except ModuleNotFoundError as error:
        raise CannotRunError(
            "PostgreSQL needs the package psycopg.", 'Install it with pip install "tune-jobs[postgresql]".'
        ) from error
    if parsed.get_backend_name() == "sqlite":
        event.listen(engine, "connect", _set_pragmas)
        event.listen(engine, "begin", _begin_at_once)
    try:
        _migrate(engine, told)
        if _is_in_file(parsed):
            _hold_to_file(engine, Path(str(parsed.database)))
    except SQLAlchemyError as error:
        engine.dispose()
        raise CannotRunError(
            f"The service's database {told} can't be used: {reason_of(error)}.",
            "Check the address, the permissions and the space left; a damaged SQLite file can be moved away: sweeps "
            "are found again by their folders.",
        ) from error
    except CannotRunError:
        engine.dispose()
        raise
    return engine


def _patience(url: URL) -> dict[str, Any]:
    if url.drivername not in _LIBPQ:
        return {}
    return {name: value for name, value in _PATIENCE.items() if name not in url.query}


def _is_in_file(url: URL) -> bool:
    return url.get_backend_name() == "sqlite" and url.database not in (None, "", ":memory:")


def _set_pragmas(connection: Any, _record: Any) -> None:
    if not isinstance(connection, sqlite3.Connection):
        raise TypeError(f"an SQLite connection is a {type(connection)}")
    # The driver would begin transactions by itself, deferred; `_begin_at_once` does it.
    connection.isolation_level = None
    for name, value in (
        ("journal_mode", "WAL"),
        # What was answered is on the disk, also when the power fails.
        ("synchronous", "FULL"),
        ("busy_timeout", str(int(1000 * BUSY_TIMEOUT_S))),
        ("foreign_keys", "ON"),
    ):
        connection.execute(f"PRAGMA {name} = {value}")


def _hold_to_file(engine: Engine, file: Path) -> None:
    """Refuse an SQLite file that is another one by now, or none.

    A connection goes on with a file that was deleted, and what is written there is lost with the process; a new one
    would make an empty file, without tables.
    """

    def place() -> tuple[int, int]:
        found = file.stat()
        return found.st_dev, found.st_ino

    known = place()

    def check(*_: Any) -> None:
        with contextlib.suppress(OSError):
            if place() == known:
                return
        reason = f"the file {file} was deleted or replaced while it was in use; put it back, or restart the service"
        raise OperationalError(None, None, sqlite3.OperationalError(reason))

    event.listen(engine, "do_connect", check)
    event.listen(engine, "checkout", check)


def _begin_at_once(connection: Any) -> None:
    """Begin a transaction that may write: one that begins as a reader fails, not waits, when another one wrote."""
    connection.exec_driver_sql("BEGIN IMMEDIATE")


def _migrate(engine: Engine, told: str) -> None:
    # It tells each of its steps, as if somebody had asked.
    logging.getLogger("alembic").setLevel(logging.WARNING)
    config = Config()
    config.set_main_option("script_location", str(_MIGRATIONS).replace("%", "%%"))
    known = {item.revision for item in ScriptDirectory.from_config(config).walk_revisions()}
    if inspect(engine).has_table("alembic_version"):
        with engine.connect() as connection:
            found = {row[0] for row in connection.execute(text("SELECT version_num FROM alembic_version"))}
        if found - known:
            raise CannotRunError(
                f"The service's database {told} is of a newer version ({', '.join(sorted(found - known))}).",
                "Run the version of tune-jobs that wrote it, or give another database.",
            )
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        try:
            command.upgrade(config, "head")
        except CommandError as error:
            raise CannotRunError(f"The service's database {told} can't be migrated: {error}.") from error


def reason_of(error: SQLAlchemyError) -> str:
    """Return why a database can't be used, in its own words, on one line."""
    if isinstance(error, PoolTimeoutError):
        return "others have used it all the time"
    said = str(error.orig) if isinstance(error, DBAPIError) else str(error)
    return " ".join(said.split())[:300].rstrip(".")

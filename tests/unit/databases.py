"""Databases for the service's tests: SQLite in a file, and a PostgreSQL server of their own where it is installed."""

import os
import pwd
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tune_jobs.service.database.opening import sqlite_url

KINDS = ("sqlite", "postgresql")


def postgresql_programs() -> Path | None:
    """The folder of PostgreSQL's programs; Debian keeps them off the path."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres"))
    named = shutil.which("postgres")
    return found[-1].parent if found else Path(named).parent if named else None


class PostgreSQL:
    """A server in a folder of its own, reached through a socket there alone."""

    def __init__(self, programs: Path) -> None:
        self._programs = programs
        # Paths of sockets have to be short.
        self.folder = Path(tempfile.mkdtemp(prefix="pg-", dir="/tmp"))
        self._count = 0
        # The server refuses to be run by root.
        self._user = "postgres" if os.geteuid() == 0 else None
        if self._user:
            shutil.chown(self.folder, self._user)
        self._run(
            "initdb", "--pgdata", str(self.folder / "data"), "--auth", "trust", "--username", "postgres", "--no-sync"
        )
        self._server: subprocess.Popen[bytes] | None = None
        self.start()

    def _command(self, name: str, *arguments: str) -> list[str]:
        as_user = ["setpriv", f"--reuid={self._user}", f"--regid={self._user}", "--clear-groups"] if self._user else []
        return [*as_user, str(self._programs / name), *arguments]

    def _run(self, name: str, *arguments: str) -> None:
        subprocess.run(self._command(name, *arguments), check=True, capture_output=True, cwd=self.folder)

    def start(self) -> None:
        """Start the server, and wait until it answers."""
        settings = ["-c", "listen_addresses=", "-c", f"unix_socket_directories={self.folder}", "-c", "fsync=off"]
        with (self.folder / "log").open("ab") as log:
            self._server = subprocess.Popen(
                self._command("postgres", "-D", str(self.folder / "data"), *settings),
                stdout=log, stderr=log, cwd=self.folder,
            )  # fmt: skip
        deadline = time.monotonic() + 60
        while subprocess.run(
            self._command("pg_isready", "-h", str(self.folder)), check=False, capture_output=True, cwd=self.folder
        ).returncode:
            assert self._server.poll() is None, (self.folder / "log").read_text()
            assert time.monotonic() < deadline
            time.sleep(0.05)

    def kill(self) -> None:
        """End the server as by a crash."""
        assert self._server is not None
        children = Path(f"/proc/{self._server.pid}/task/{self._server.pid}/children").read_text().split()
        self._server.kill()
        self._server.wait()
        # They end as they see that it is gone; a new one would refuse to begin before.
        deadline = time.monotonic() + 60
        while any(_lives(pid) for pid in children):
            assert time.monotonic() < deadline
            time.sleep(0.05)

    def stop(self) -> None:
        """End it, and remove its folder."""
        assert self._server is not None
        self._server.send_signal(2)
        self._server.wait(30)
        shutil.rmtree(self.folder, ignore_errors=True)

    def new_database(self) -> str:
        """Make an empty database, and return its URL."""
        self._count += 1
        name = f"test{self._count}"
        self._run("createdb", "-h", str(self.folder), "-U", "postgres", name)
        return f"postgresql://postgres@/{name}?host={self.folder}"


def _lives(pid: str) -> bool:
    """Whether a process is there and has not ended: of one that nobody has waited for yet, the command is empty."""
    try:
        return bool(Path(f"/proc/{pid}/cmdline").read_bytes())
    except OSError:
        return False


def started_or_skip() -> PostgreSQL:
    """A server of its own; where none can be started, the test is skipped."""
    programs = postgresql_programs()
    if programs is None:
        pytest.skip("PostgreSQL is not installed")
    if os.geteuid() == 0:
        try:
            pwd.getpwnam("postgres")
        except KeyError:
            pytest.skip("PostgreSQL can't be run by root, and there is no user postgres")
    return PostgreSQL(programs)


@pytest.fixture(scope="session")
def postgresql() -> Iterator[PostgreSQL]:
    """A server for the session."""
    server = started_or_skip()
    yield server
    server.stop()


@pytest.fixture(params=KINDS)
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The URL of a database that is new, of each kind."""
    if request.param == "sqlite":
        return sqlite_url(tmp_path / "service.db")
    server: PostgreSQL = request.getfixturevalue("postgresql")
    return server.new_database()

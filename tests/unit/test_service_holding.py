"""A database is one service's: a second one is refused, whatever its storage folder, until the first one has ended."""

import errno
import fcntl
import functools
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import pytest
from databases import PostgreSQL, database_url, postgresql, started_or_skip  # noqa: F401 (fixtures)
from fake_sweeps import RunCommand, run  # noqa: F401 (a fixture)
from live_service import wait_until
from sqlalchemy import Engine, text
from sqlalchemy.exc import SQLAlchemyError
from sweep_folders import make_sweep_folder

from policies.errors import CannotRunError
from tests.narrowing import present
from tune_jobs.service import service as module
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.database import holding
from tune_jobs.service.database.holding import Hold, held
from tune_jobs.service.database.opening import open_database, sqlite_url
from tune_jobs.service.jobs import Job
from tune_jobs.service.service import Service, opened
from tune_jobs.service.spare import Driver
from tune_jobs.service.supervisor import Supervisor

# ruff: noqa: F811 - fixtures are named as arguments

TAKEN = "Another service uses the database"
HOLDING = """
import sys, threading
from tune_jobs.service.database.holding import held
from tune_jobs.service.database.opening import open_database
with held(open_database(sys.argv[1])):
    print("held", flush=True)
    threading.Event().wait(120)
"""


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(holding, "_PATIENCE_S", 0.2)


def config(storage: Path, url: str) -> ServiceConfig:
    return ServiceConfig(storage=storage, database=url, spare_idle_s=0.0)


@pytest.mark.parametrize("is_own", [True, False])
def test_a_folder_is_one_services_and_is_named(tmp_path: Path, *, is_own: bool) -> None:
    storages = (tmp_path / "a", tmp_path / ("b" if is_own else "a"))
    first, second = (ServiceConfig(path, own_folder=tmp_path / "own" if is_own else None) for path in storages)
    named, option = (tmp_path / "own", "--folder") if is_own else (tmp_path / "a", "--storage")
    with module._alone(first), pytest.raises(CannotRunError) as refused, opened(second):
        pass
    assert refused.value.message == f"Another service has the {'' if is_own else 'storage '}folder {named}."
    assert refused.value.hint == f"End it first, or give another {option}."


@pytest.mark.parametrize("is_own", [True, False])
def test_a_folder_without_locks_is_not_said_to_be_anothers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, is_own: bool
) -> None:
    def flock(descriptor: int, operation: int) -> NoReturn:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    folder, option = (tmp_path / "own", "--folder") if is_own else (tmp_path / ".service", "--storage")
    monkeypatch.setattr(fcntl, "flock", flock)
    with (
        pytest.raises(CannotRunError) as refused,
        opened(ServiceConfig(tmp_path, own_folder=folder if is_own else None)),
    ):
        pass
    assert refused.value.message == f"The service can't lock {folder / 'lock'}: Function not implemented."
    assert refused.value.hint == f"Give another {option}, on a file system that has locks."


def test_an_own_folder_that_is_a_file_is_no_matter_of_the_storage(tmp_path: Path) -> None:
    (tmp_path / "own").touch()
    with pytest.raises(CannotRunError) as refused, opened(ServiceConfig(tmp_path, own_folder=tmp_path / "own")):
        pass
    assert str(tmp_path / "own") in refused.value.message
    assert refused.value.hint == "Check the folder."


def test_a_second_service_is_refused_and_leaves_the_first_ones_jobs_alone(tmp_path: Path, database_url: str) -> None:
    first, second = (config(tmp_path / name, database_url) for name in "ab")

    def jobs_after_a_look() -> list[Job]:
        service.supervisor._look()
        return service.queue.jobs()

    with opened(first) as service:
        service.supervisor.close()
        # One is being written, and one waits for whoever drives its sweep.
        writes = service.queue.begin("being-written", "drive", {}, owner="ann", state="creating")[0]
        with make_sweep_folder(tmp_path / "a" / "mine").lock():
            waits = service.queue.begin("mine", "drive", {}, owner="ann", num_cpus=1.0)[0]
            assert jobs_after_a_look() == [writes, waits]
            with pytest.raises(CannotRunError, match=TAKEN) as refused, opened(second):
                pass
            assert refused.value.hint == "Give each service a database of its own."
            assert jobs_after_a_look() == [writes, waits]
    with opened(second):
        pass


def test_commands_use_the_database_of_a_service(run: RunCommand, tmp_path: Path, database_url: str) -> None:
    with opened(config(tmp_path / "a", database_url)) as service:
        made = run("token", "make", "ann", "--role", "viewer", "--database", database_url)
        assert made.exit_code == 0, made.output
        assert service.gate.tokens.any_valid()


def test_who_was_killed_holds_it_no_more(database_url: str) -> None:
    with subprocess.Popen([sys.executable, "-c", HOLDING, database_url], stdout=subprocess.PIPE) as killed:
        try:
            assert present(killed.stdout).readline() == b"held\n"
            engine = open_database(database_url)
            with pytest.raises(CannotRunError, match=TAKEN), held(engine):
                pass
        finally:
            killed.kill()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(holding, "_PATIENCE_S", 20.0)
        with held(engine):
            pass
    engine.dispose()


def test_a_file_has_one_lock_by_whatever_name(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "folder")
    one, other = (open_database(sqlite_url(tmp_path / name / "service.db")) for name in ("folder", "link"))
    with held(one), pytest.raises(CannotRunError, match=TAKEN), held(other):
        pass
    one.dispose()
    other.dispose()


def test_a_lock_that_can_not_be_written_is_told(tmp_path: Path) -> None:
    engine = open_database(sqlite_url(tmp_path / "service.db"))
    (tmp_path / "service.db.held").mkdir()
    with pytest.raises(CannotRunError, match=r"can't write .*service\.db\.held: Is a directory\."), held(engine):
        pass
    engine.dispose()


class TestPostgreSQL:
    """A server of its own, which is stopped and started again."""

    @pytest.fixture
    def server(self) -> Iterator[PostgreSQL]:
        made = started_or_skip()
        yield made
        made.stop()

    @pytest.fixture
    def engine(self, server: PostgreSQL) -> Iterator[Engine]:
        made = open_database(server.new_database())
        yield made
        made.dispose()

    def test_it_is_taken_again_after_an_outage(self, server: PostgreSQL, engine: Engine) -> None:
        other = Hold(engine)
        with held(engine) as hold:
            server.kill()
            with pytest.raises(SQLAlchemyError):
                hold.check()
            server.start()
            hold.check()
            with pytest.raises(CannotRunError, match=TAKEN):
                other.check()
        other.check()
        other.close()

    def test_who_was_overtaken_in_an_outage_looks_at_no_queue_until_it_is_free(
        self, server: PostgreSQL, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
        fake = functools.partial(Supervisor, make_driver=functools.partial(Driver, module="fake_driver"))
        monkeypatch.setattr(module, "Supervisor", fake)
        with opened(config(tmp_path / "a", server.new_database())) as service:
            make_sweep_folder(tmp_path / "a" / "mine")
            refusals = refused_checks(monkeypatch)
            other = overtaken(service)

            def refused_once_more() -> None:
                before = len(refusals)
                service.supervisor.wake()
                wait_until(lambda: len(refusals) > before)

            # A look that began before the database was lost may still go on.
            refused_once_more()
            job = service.queue.begin("mine", "drive", {}, owner="ann", num_cpus=1.0)[0]
            refused_once_more()
            wait_until(lambda: f"The queue can't be looked at: {TAKEN}" in caplog.text)
            assert service.queue.job(job.id).state == "waiting"
            assert service.supervisor.is_alive
            other.close()
            wait_until(lambda: service.queue.job(job.id).outcome == "completed")


def refused_checks(monkeypatch: pytest.MonkeyPatch) -> list[Hold]:
    """Who checked from now on and found another one's hold; as `overtaken` does too until it has it."""
    refused: list[Hold] = []
    check = Hold.check

    def noted(hold: Hold) -> None:
        try:
            check(hold)
        except CannotRunError:
            refused.append(hold)
            raise

    monkeypatch.setattr(Hold, "check", noted)
    return refused


def overtaken(service: Service) -> Hold:
    """Another service's hold of a database, taken as the connection of the first one was lost."""
    other = Hold(service.engine)
    lost = text("SELECT pg_terminate_backend(pid) FROM pg_locks WHERE locktype = 'advisory'")

    def has_it() -> bool:
        with service.engine.begin() as connection:
            connection.execute(lost)
        try:
            other.check()
        except CannotRunError:
            return False
        return True

    wait_until(has_it)
    return other

"""The queue: which job is next, what is remembered, and that each change happens once; in both databases."""

import functools
import itertools
import json
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from databases import database_url, postgresql  # noqa: F401 (fixtures)
from sqlalchemy import Engine, text
from sqlalchemy.exc import SQLAlchemyError

from policies.errors import CannotRunError, NotFoundError
from tune_jobs.service.database import opening
from tune_jobs.service.database.opening import open_database, sqlite_url
from tune_jobs.service.database.tables import metadata
from tune_jobs.service.jobs import Job
from tune_jobs.service.labels import Label, Labels
from tune_jobs.service.queue import KeyUsedError, Queue


@pytest.fixture
def engine(database_url: str) -> Iterator[Engine]:  # noqa: F811
    made = open_database(database_url)
    yield made
    made.dispose()


@pytest.fixture
def queue(engine: Engine) -> Queue:
    times = itertools.count(1_000)
    return Queue(engine, now=lambda: float(next(times)))


def add(queue: Queue, sweep: str, owner: str = "ann", priority: int = 0, num_cpus: float = 1.0) -> Job:
    return queue.begin(sweep, "drive", {}, owner=owner, priority=priority, num_cpus=num_cpus)[0]


def claimed(queue: Queue, num_cpus: float = 1.0) -> str | None:
    """The next sweep, whose job ends at once."""
    job = queue.claim(num_cpus)
    if job is None:
        return None
    queue.end(job.id, "completed")
    return job.sweep


# -- which is next


def test_jobs_run_in_the_order_in_which_they_came(queue: Queue) -> None:
    for name in ("a", "b", "c"):
        add(queue, name)
    assert [claimed(queue) for _ in range(4)] == ["a", "b", "c", None]


def test_the_higher_priority_goes_first(queue: Queue) -> None:
    add(queue, "low", priority=-1)
    add(queue, "usual")
    add(queue, "high", priority=5)
    assert [claimed(queue) for _ in range(3)] == ["high", "usual", "low"]


def test_owners_take_turns(queue: Queue) -> None:
    for name in ("a1", "a2", "a3"):
        add(queue, name, owner="ann")
    for name in ("b1", "b2"):
        add(queue, name, owner="bob")
    assert [claimed(queue) for _ in range(5)] == ["a1", "b1", "a2", "b2", "a3"]


def test_who_has_fewer_running_goes_first(queue: Queue) -> None:
    add(queue, "a1", owner="ann")
    assert queue.claim(8.0) is not None
    add(queue, "a2", owner="ann")
    add(queue, "b1", owner="bob")
    job = queue.claim(8.0)
    assert job is not None
    assert job.sweep == "b1"


def test_one_that_does_not_fit_is_waited_for(queue: Queue) -> None:
    add(queue, "running", num_cpus=1.0)
    assert queue.claim(2.0) is not None
    add(queue, "large", owner="bob", num_cpus=2.0)
    add(queue, "small", owner="bob", num_cpus=1.0)
    # The small one would fit, but then there would be always another small one.
    assert queue.claim(2.0) is None
    queue.end(queue.jobs("running")[0].id, "completed")
    job = queue.claim(2.0)
    assert job is not None
    assert job.sweep == "large"


def test_one_that_never_fits_runs_alone(queue: Queue) -> None:
    add(queue, "huge", num_cpus=64.0)
    job = queue.claim(2.0)
    assert job is not None
    assert job.sweep == "huge"


def test_jobs_of_one_sweep_run_one_after_the_other(queue: Queue) -> None:
    add(queue, "a")
    queue.begin("a", "extend", {"to_num_samples": 4}, owner="ann", priority=9, num_cpus=1.0)
    job = queue.claim(8.0)
    assert job is not None
    assert job.verb == "drive"
    assert queue.claim(8.0) is None
    queue.end(job.id, "completed")
    job = queue.claim(8.0)
    assert job is not None
    assert job.verb == "extend"


def test_a_sweep_that_may_not_run_holds_up_nobody(queue: Queue) -> None:
    add(queue, "a")
    add(queue, "b")
    job = queue.claim(8.0, lambda name: name != "a")
    assert job is not None
    assert job.sweep == "b"


# -- what becomes of a job


def test_a_job_that_is_given_back_waits_and_keeps_when_it_began(queue: Queue) -> None:
    add(queue, "a")
    job = queue.claim(1.0)
    assert job is not None
    queue.give_back(job.id)
    again = queue.claim(1.0)
    assert again is not None
    assert (again.id, again.num_attempts, again.started_at) == (job.id, 2, job.started_at)


def test_an_end_is_not_changed_any_more(queue: Queue) -> None:
    job = add(queue, "a")
    ended = queue.end(job.id, "cancelled")
    assert queue.end(job.id, "completed") == ended
    assert queue.give_back(job.id) == ended
    assert queue.request_stop("a") == []


def test_a_stop_cancels_what_waits_and_asks_what_runs(queue: Queue) -> None:
    add(queue, "a")
    queue.claim(1.0)
    add(queue, "a")
    running, waiting = queue.request_stop("a")
    assert (running.state, running.stop_requested) == ("running", True)
    assert (waiting.state, waiting.outcome) == ("ended", "cancelled")


def test_a_priority_is_changed_while_a_job_waits(queue: Queue) -> None:
    add(queue, "a")
    add(queue, "b")
    queue.set_priority("b", 7)
    assert claimed(queue) == "b"


def test_there_is_no_such_job(queue: Queue) -> None:
    with pytest.raises(NotFoundError, match="no job 7"):
        queue.job(7)


def test_numbers_of_jobs_are_never_used_again(queue: Queue) -> None:
    job = add(queue, "a")
    queue.end(job.id, "completed")
    queue.remove_sweep("a")
    assert add(queue, "a").id > job.id


# -- idempotency keys


def test_a_request_that_is_repeated_gives_the_same_job(queue: Queue) -> None:
    first, is_new = queue.begin("a", "drive", {}, owner="ann", key=("k", "digest"))
    again, is_new_again = queue.begin("a", "drive", {}, owner="ann", key=("k", "digest"))
    other, _ = queue.begin("b", "drive", {}, owner="bob", key=("k", "of another request"))
    assert (is_new, is_new_again) == (True, False)
    assert again == first
    assert other.id != first.id


def test_a_key_for_another_request_is_refused(queue: Queue) -> None:
    queue.begin("a", "drive", {}, owner="ann", key=("k", "digest"))
    with pytest.raises(KeyUsedError, match="'k'"):
        queue.begin("b", "drive", {}, owner="ann", key=("k", "another"))
    assert len(queue.jobs()) == 1


def test_what_could_not_be_made_may_be_sent_again(queue: Queue) -> None:
    job, _ = queue.begin("a", "drive", {}, owner="ann", key=("k", "digest"), state="creating")
    queue.forget(job.id)
    again, is_new = queue.begin("a", "drive", {}, owner="ann", key=("k", "digest"), state="creating")
    assert is_new
    assert queue.created(again.id, num_cpus=2.0).state == "waiting"
    queue.forget(again.id)
    assert [item.id for item in queue.jobs()] == [again.id]


# -- at once


def at_once(calls: list[Callable[[], object]]) -> list[object]:
    barrier, found = threading.Barrier(len(calls)), []

    def run(call: Callable[[], object]) -> None:
        barrier.wait()
        found.append(call())

    threads = [threading.Thread(target=run, args=(call,)) for call in calls]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == len(calls), "one of the threads raised an error"
    return found


def test_of_equal_requests_at_once_one_makes_a_job(queue: Queue) -> None:
    found = at_once([lambda: queue.begin("a", "drive", {}, owner="ann", key=("k", "d"))] * 8)
    jobs = {result[0].id for result in found}  # type: ignore[index]
    assert len(jobs) == 1
    assert sum(result[1] for result in found) == 1  # type: ignore[index]
    assert len(queue.jobs()) == 1


def test_a_new_sweep_is_labelled_by_several_at_once(engine: Engine) -> None:
    labels = Labels(engine)
    for turn in range(10):
        changes: list[dict[str, Any]] = [{"owner": "ann"}, {"note": "mine"}, {"tags": ["a"]}, {}] * 2
        at_once([functools.partial(labels.change, f"s{turn}", **change) for change in changes])
        assert labels.of(f"s{turn}") == Label("ann", "mine", ("a",))


def test_a_job_is_claimed_once(queue: Queue) -> None:
    for index in range(4):
        add(queue, f"s{index}")
    found = at_once([lambda: queue.claim(100.0)] * 8)
    taken = [job.id for job in found if isinstance(job, Job)]
    assert len(taken) == len(set(taken))
    assert len(queue.jobs("running")) == len(taken)


# -- the database


def test_the_tables_are_those_of_the_migrations(engine: Engine) -> None:
    from alembic.autogenerate import compare_metadata
    from alembic.migration import MigrationContext

    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), metadata) == []


def test_a_database_is_opened_again(database_url: str) -> None:  # noqa: F811
    for _ in range(2):
        engine = open_database(database_url)
        add(Queue(engine), "a")
        engine.dispose()
    engine = open_database(database_url)
    assert [job.sweep for job in Queue(engine).jobs()] == ["a", "a"]
    engine.dispose()


def test_the_jobs_of_an_older_version_are_kept(database_url: str) -> None:  # noqa: F811
    engine = open_database(database_url)
    job = add(Queue(engine), "a")
    with engine.begin() as connection:
        connection.execute(text("ALTER TABLE jobs DROP COLUMN finish_failed"))
        connection.execute(text("ALTER TABLE sweeps DROP COLUMN created_at"))
        connection.execute(text("UPDATE alembic_version SET version_num = '0002'"))
    engine.dispose()
    engine = open_database(database_url)
    assert Queue(engine).jobs() == [job]
    assert Queue(engine).end(job.id, "completed", finish_failed=True).finish_failed is True
    engine.dispose()


def test_the_labels_of_an_older_version_are_kept(database_url: str) -> None:  # noqa: F811
    engine = open_database(database_url)
    Labels(engine).change("a", owner="ann", note="mine", tags=["x"])
    with engine.begin() as connection:
        connection.execute(text("ALTER TABLE sweeps DROP COLUMN created_at"))
        connection.execute(text("UPDATE alembic_version SET version_num = '0003'"))
    engine.dispose()
    engine = open_database(database_url)
    labels = Labels(engine)
    label = labels.of("a")
    assert label == labels.all()["a"] == Label("ann", "mine", ("x",), None)
    # It does not say of which sweep, and is believed.
    assert label.of(1_700_000_000.25) == label
    # Once somebody changes it, it does.
    changed = labels.change("a", note="mine too", created_at=1_700_000_000.25)
    assert changed == Label("ann", "mine too", ("x",), 1_700_000_000.25)
    assert changed.of(1_700_000_000.5) == Label()
    engine.dispose()


def test_what_is_said_of_a_new_sweep_takes_nothing_over_from_an_earlier_one_of_the_name(engine: Engine) -> None:
    labels, created_at = Labels(engine), 1_759_412_345.678912
    labels.change("a", owner="ann", note="mine", tags=["x"], created_at=created_at)
    labels.change("a", tags=["y"], created_at=created_at)
    labels.change("a", note="still mine")
    assert labels.of("a") == Label("ann", "still mine", ("y",), created_at)
    assert labels.change("a", note="new", created_at=created_at + 60.0) == Label(None, "new", (), created_at + 60.0)


def test_a_newer_database_is_refused(engine: Engine, database_url: str) -> None:  # noqa: F811
    with engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(CannotRunError, match="newer version \\(9999\\)"):
        open_database(database_url)


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "service.db"
    file.write_bytes(b"this is no database" * 100)
    with pytest.raises(CannotRunError, match=r"not a database"):
        open_database(sqlite_url(file))


@pytest.mark.parametrize(("url", "told"), [
    ("mysql://root@host/name", "SQLite or PostgreSQL"),
    ("nonsense", "no database URL"),
    ("oracle+nothing://x", "."),
    ("postgresql://nobody@/none?host=/nonexistent", "can't be used"),
    ("sqlite:////nonexistent/folder/service.db", "unable to open"),
])  # fmt: skip
def test_what_is_no_database_is_refused(url: str, told: str) -> None:
    with pytest.raises(CannotRunError, match=told):
        open_database(url)


def test_the_password_of_a_database_is_never_told() -> None:
    with pytest.raises(CannotRunError) as caught:
        open_database("postgresql://me:hunter2@/none?host=/nonexistent")
    assert "hunter2" not in str(caught.value)


def test_sqlite_keeps_what_it_has_answered(tmp_path: Path) -> None:
    engine = open_database(sqlite_url(tmp_path / "service.db"))
    with engine.connect() as connection:
        found = {name: connection.execute(text(f"PRAGMA {name}")).scalar() for name in ("journal_mode", "synchronous")}
    engine.dispose()
    assert found == {"journal_mode": "wal", "synchronous": 2}


@pytest.mark.parametrize("name", ["what?", "50%25 runs", "100%", "{a}&b=c#d"])
def test_a_file_may_have_any_letters(name: str, tmp_path: Path) -> None:
    file = tmp_path / "out" / name / "service.db"
    file.parent.mkdir(parents=True)
    engine = open_database(sqlite_url(file))
    add(Queue(engine), "a")
    engine.dispose()
    with closing(sqlite3.connect(file)) as connection:
        assert connection.execute("SELECT COUNT(*) FROM jobs").fetchone() == (1,)
    assert [found for found in (tmp_path / "out").rglob("*") if found.is_file()] == [file]


def test_a_reader_is_let_in_while_another_process_writes(tmp_path: Path) -> None:
    engine = open_database(sqlite_url(tmp_path / "service.db"))
    queue = Queue(engine)
    job = add(queue, "a")
    with sqlite3.connect(tmp_path / "service.db") as other:
        assert json.loads(other.execute("SELECT arguments FROM jobs").fetchone()[0]) == {}
    assert queue.job(job.id) == job
    engine.dispose()


def test_a_crowd_of_threads_waits_for_its_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # What finds the file taken is refused soon, and none finds it so: each has its turn, however slow the disk is.
    monkeypatch.setattr(opening, "BUSY_TIMEOUT_S", 0.2)
    monkeypatch.setattr(opening, "TURN_TIMEOUT_S", 300.0)
    engine = open_database(sqlite_url(tmp_path / "service.db"))
    queue, refused = Queue(engine), list[Exception]()

    def submit(number: int) -> None:
        for turn in range(10):
            try:
                add(queue, f"{number}-{turn}")
            except SQLAlchemyError as error:
                refused.append(error)

    threads = [threading.Thread(target=submit, args=(number,)) for number in range(40)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert refused == []
    assert len(queue.jobs("waiting")) == 400
    engine.dispose()

"""Of which waiting sweeps it is asked whether they may run: of as few as it takes, as each may take requests."""

from collections.abc import Callable
from typing import Any

import pytest
from databases import database_url, postgresql  # noqa: F401 (fixtures)
from sqlalchemy import Engine, QueuePool, event
from test_service_queue import add, engine, queue  # noqa: F401 (fixtures)
from test_service_supervisor import Place, place  # noqa: F401 (a fixture)

from tests.narrowing import present
from tune_jobs.service.queue import Queue
from tune_jobs.store.sweep_store import SweepStore

# ruff: noqa: F811 - fixtures are named as arguments


def noting(asked: list[str], *others: str) -> Callable[[str], bool]:
    """All may run but those that others drive."""

    def may_run(name: str) -> bool:
        asked.append(name)
        return name not in others

    return may_run


def is_free(engine: Engine) -> bool:
    """Whether nobody uses the database just now, which a claim locks for all others."""
    assert isinstance(engine.pool, QueuePool)
    return engine.pool.checkedout() == 0


def test_sweeps_are_asked_of_in_their_order_until_one_may_run(queue: Queue) -> None:
    for name in ("a1", "a2", "a3"):
        add(queue, name)
    add(queue, "b1", owner="bob")
    add(queue, "high", priority=1)
    asked: list[str] = []
    assert present(queue.claim(8.0, noting(asked))).sweep == "high"
    assert asked == ["high"]
    asked.clear()
    # Bob has none that runs.
    assert present(queue.claim(8.0, noting(asked, "b1", "a1"))).sweep == "a2"
    assert asked == ["b1", "a1", "a2"]


def test_of_none_is_asked_where_none_fits_and_of_the_next_alone_where_a_smaller_one_would(queue: Queue) -> None:
    add(queue, "running")
    present(queue.claim(2.0))
    add(queue, "large", num_cpus=2.0)
    add(queue, "larger", num_cpus=3.0)
    asked: list[str] = []
    assert queue.claim(2.0, noting(asked)) is None
    assert asked == []
    add(queue, "small")
    assert queue.claim(2.0, noting(asked)) is None
    assert asked == ["large"]
    # What somebody else drives is not waited for.
    assert present(queue.claim(2.0, noting([], "large", "larger"))).sweep == "small"


def test_one_that_comes_while_a_store_is_asked_waits_for_the_next_claim(queue: Queue, engine: Engine) -> None:
    add(queue, "a")

    def may_run(name: str) -> bool:
        assert is_free(engine)
        add(queue, "urgent", priority=9)
        return True

    assert present(queue.claim(8.0, may_run)).sweep == "a"
    assert present(queue.claim(8.0, noting([]))).sweep == "urgent"


def test_one_that_is_cancelled_while_a_store_is_asked_does_not_run(queue: Queue, engine: Engine) -> None:
    add(queue, "a")

    def may_run(name: str) -> bool:
        assert is_free(engine)
        return bool(queue.request_stop(name))

    assert queue.claim(8.0, may_run) is None


def test_jobs_that_have_ended_are_not_read_one_by_one(queue: Queue, engine: Engine) -> None:
    for number in range(10):
        add(queue, f"{number}", owner="ann" if number % 2 else "bob")
        queue.end(present(queue.claim(1.0)).id, "completed")
    add(queue, "ann's")
    add(queue, "bob's", owner="bob")
    read: list[tuple[str, Any]] = []

    def note(_: object, __: object, statement: str, parameters: Any, *___: object) -> None:
        if statement.startswith("SELECT"):
            read.append((statement, parameters))

    event.listen(engine, "before_cursor_execute", note)
    # Ann's last one began after his.
    assert present(queue.claim(1.0)).sweep == "bob's"
    event.remove(engine, "before_cursor_execute", note)
    with engine.begin() as connection:
        num_rows = [len(connection.exec_driver_sql(*each).all()) for each in read]
    assert max(num_rows) == 2


def test_a_service_whose_cpus_are_all_used_looks_at_no_lock_of_those_that_wait(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    is_driven = SweepStore.is_driven

    def noted(store: SweepStore) -> bool:
        asked.append(store.name)
        return is_driven(store)

    monkeypatch.setattr(SweepStore, "is_driven", noted)
    service = place.new_service(num_cpus=1.0)
    runs = place.submit("runs", seconds=100)
    for number in range(3):
        place.submit(f"waits{number}")
    service._look()
    place.until_it_runs(runs)
    assert asked[0] == "runs"
    asked.clear()
    for _ in range(5):
        service._look()
    assert [name for name in asked if name != "runs"] == []
    # Each is asked of once a look, whoever drives it.
    place.queue.request_stop("runs")
    with SweepStore(place.folder / "waits0").lock(), SweepStore(place.folder / "waits1").lock():

        def looked() -> bool:
            asked.clear()
            service._look()
            return place.queue.job(runs.id).state == "ended"

        place.wait(looked, "it never ended")
        assert [name for name in asked if name != "runs"] == ["waits0", "waits1", "waits2"]
    service.close()

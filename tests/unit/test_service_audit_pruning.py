"""The audit log forgets what is older than it is told to keep, at the start and daily."""

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
from databases import database_url, postgresql  # noqa: F401 (fixtures)
from live_service import wait_until
from sqlalchemy import Engine

from tune_jobs.service.access import pruning as module
from tune_jobs.service.access.audit import Audit, Done
from tune_jobs.service.access.pruning import Pruning
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.database.opening import open_database
from tune_jobs.service.service import opened

# ruff: noqa: F811 - fixtures are named as arguments
DAY_S = 86_400.0


class Clock:
    def __init__(self) -> None:
        self.at = 1_000_000_000.0

    def __call__(self) -> float:
        return self.at


@pytest.fixture
def engine(database_url: str) -> Iterator[Engine]:
    made = open_database(database_url)
    yield made
    made.dispose()


def write(audit: Audit, clock: Clock, *ages_days: float) -> None:
    now = clock.at
    for age in ages_days:
        clock.at = now - age * DAY_S
        audit.write(Done("ann", "", "stop", f"{age:g}", 200, {}))
    clock.at = now


def left(audit: Audit) -> list[str]:
    return [entry.target for entry in audit.page(limit=100)[0]][::-1]


def test_what_is_older_than_is_kept_is_removed(engine: Engine, caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()
    audit = Audit(engine, clock)
    write(audit, clock, 400, 366, 365.5, 364, 1, 0)
    with caplog.at_level(logging.INFO):
        assert Pruning(audit, 365).prune() == 3
    assert left(audit) == ["364", "1", "0"]
    assert "3 entries of the audit log were older than 365 days" in caplog.text
    assert Pruning(audit, 365).prune() == 0
    assert Pruning(audit, 0.5).prune() == 2


def test_many_are_removed_in_parts(engine: Engine) -> None:
    clock = Clock()
    audit = Audit(engine, clock)
    write(audit, clock, *range(20, 10, -1), 1)
    assert audit.remove_older(10 * DAY_S, limit=4) == 4
    assert left(audit)[0] == "16"
    assert Pruning(audit, 10).prune() == 6
    assert left(audit) == ["1"]


def test_it_is_done_at_the_start_and_again(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PAUSE_S", 0.05)
    clock = Clock()
    audit = Audit(engine, clock)
    write(audit, clock, 20, 5)
    made = Pruning(audit, 10)
    made.start()
    wait_until(lambda: left(audit) == ["5"])
    clock.at += 6 * DAY_S
    wait_until(lambda: left(audit) == [])
    made.close()


def test_a_service_prunes_its_log(tmp_path: Path, engine: Engine, database_url: str) -> None:
    clock = Clock()
    # In 2001.
    write(Audit(engine, clock), clock, 0)
    config = ServiceConfig(storage=tmp_path / "sweeps", database=database_url, spare_idle_s=0, keep_audit_days=30)
    with opened(config) as service:
        wait_until(lambda: left(service.gate.audit) == [])

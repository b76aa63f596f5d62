"""What those who watch a sweep hear where it could not be looked at for a while."""

import threading
from typing import Any

import pytest
from live_service import Live, live, wait_until  # noqa: F401 (a fixture)
from sqlalchemy.exc import OperationalError
from test_service_events import iteration, rows_of, store  # noqa: F401 (a fixture)

from tune_jobs.service import watching
from tune_jobs.store.sweep_store import SweepStore

# ruff: noqa: F811 - fixtures are named as arguments


def test_after_looks_that_failed_all_is_asked_for_anew(
    live: Live, store: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such a look has read changes that it told nobody of."""
    monkeypatch.setattr(watching, "_MOST_WAIT_S", 0.2)
    with live.events("/sweeps/mine/events") as reader:
        reader.wait_for(lambda: reader.of("status"))
        real, failed = live.service.queue.jobs, threading.Event()

        def jobs(*states: Any, sweep: str | None = None) -> Any:
            if sweep is not None:
                failed.set()
                raise OperationalError(None, None, Exception("it is being started again"))
            return real(*states)

        monkeypatch.setattr(live.service.queue, "jobs", jobs)
        store.trial("t0000").append_iterations([iteration(7)])
        wait_until(failed.is_set)
        monkeypatch.setattr(live.service.queue, "jobs", real)
        reader.wait_for(lambda: reader.of("reset"))
        store.trial("t0000").append_iterations([iteration(8)])
        reader.wait_for(lambda: rows_of(reader)[-1:] == [8])
        assert len(reader.of("reset")) == 1

"""A service whose database has fallen silent: its sweeps save at its end all the same, and nothing waits for ever."""

import functools
import logging
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from live_service import serving
from sqlalchemy import Engine, event
from sqlalchemy.exc import OperationalError
from test_service_supervisor import Place, place  # noqa: F401 (a fixture)

from policies.errors import CannotRunError
from tune_jobs.service import supervisor as module
from tune_jobs.service.access.audit import Audit
from tune_jobs.service.access.pruning import Pruning
from tune_jobs.service.database.holding import Hold, held
from tune_jobs.service.database.opening import open_database, sqlite_url
from tune_jobs.service.ending import within
from tune_jobs.service.event_log import EventLog
from tune_jobs.service.events import Watch
from tune_jobs.service.watching import Follower, Watching

# ruff: noqa: F811 - fixtures are named as arguments


class Silence:
    """What a silent database does: whoever asks waits until the test is over."""

    def __init__(self) -> None:
        self.asked, self.over = threading.Event(), threading.Event()

    def __call__(self, *_: Any, **__: Any) -> list[Any]:
        self.asked.set()
        self.over.wait(60)
        return []


@pytest.fixture
def silence() -> Iterator[Silence]:
    made = Silence()
    yield made
    made.over.set()


class View:
    """A view that is seen once, and then no more."""

    interval_s = 0.01

    def __init__(self, then: Callable[[], list[Any]]) -> None:
        self._then, self._count = then, 0

    def changes(self) -> list[Any]:
        self._count += 1
        return [] if self._count == 1 else self._then()


def follow(watching: Watching, silence: Silence, monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Follow sweeps until their looks wait for the silent database."""
    monkeypatch.setattr(watching, "_made", lambda name: Follower(f"sweep {name}", View(silence), EventLog("s")))
    for name in names:
        silence.asked.clear()
        watching.sweep(name)
        assert silence.asked.wait(10)


def seconds(call: Callable[[], object], most_s: float = 20.0) -> float:
    """How long a call takes, which is waited for no longer than `most_s`."""
    began = time.monotonic()
    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(most_s)
    return time.monotonic() - began


def test_followers_that_wait_for_a_silent_database_are_left_together(
    silence: Silence, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    unused: Any = None
    watching = Watching(unused, unused, unused, unused, 10)
    follow(watching, silence, monkeypatch, "a", "b", "c", "d")
    with caplog.at_level(logging.WARNING):
        assert seconds(watching.close) < 5.0
    assert "looks at sweep a, looks at sweep b, looks at sweep c and 1 more." in caplog.text


def test_sweeps_save_though_a_follower_waits(tmp_path: Path, silence: Silence, monkeypatch: pytest.MonkeyPatch) -> None:
    drained: list[float] = []

    def drain(limit_s: float) -> bool:
        drained.append(limit_s)
        return True

    with serving(tmp_path / "sweeps") as live:
        follow(live.service.watching, silence, monkeypatch, "a")
        monkeypatch.setattr(live.service.supervisor, "drain", drain)
        live.server.should_exit = True
        live.thread.join(15)
        was_drained = list(drained)
        silence.over.set()
    assert was_drained == [1.0]


def test_a_queue_that_does_not_answer_holds_no_draining(
    place: Place, silence: Silence, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "within", functools.partial(within, limit_s=0.3))
    service = place.new_service()
    service.start()
    monkeypatch.setattr(place.queue, "jobs", silence)
    assert silence.asked.wait(10)
    with caplog.at_level(logging.WARNING):
        assert seconds(lambda: service.drain(1.0)) < 10.0
    assert "The queue can't be looked at: No answer came within 0.3 s." in caplog.text
    assert "waits no longer, as for a silent database, for: queue." in caplog.text


def test_a_look_that_outlived_its_service_changes_nothing(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    job = place.submit("a")
    place.submit("b")
    service, jobs = place.new_service(num_cpus=8.0), place.queue.jobs
    place.queue.claim(8.0)

    def late(*states: Any) -> Any:
        found = jobs(*states)
        service.close()
        return found

    with monkeypatch.context() as patch:
        patch.setattr(place.queue, "jobs", late)
        service._look()
    assert [(item.id, item.state, item.num_attempts) for item in jobs("running")] == [(job.id, "running", 1)]
    place.queue.end(job.id, "stopped")
    service = place.new_service(num_cpus=8.0)
    with monkeypatch.context() as patch:
        patch.setattr(place.queue, "jobs", late)
        service._look()
    assert [item.sweep for item in jobs("waiting")] == ["b"]


def test_parts_that_wait_for_a_silent_database_are_left(
    silence: Silence, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("tune_jobs.service.events.LOOK_S", 0.01)
    unused: Any = None
    pruning, watch = Pruning(Audit(unused), 1.0), Watch(unused, unused, unused)
    for part, name in ((pruning, "prune"), (watch, "look")):
        silence.asked.clear()
        monkeypatch.setattr(part, name, silence)
        part.start()
        assert silence.asked.wait(10)
        with caplog.at_level(logging.WARNING):
            assert seconds(part.close) < 10.0
    assert "for: pruning the audit log." in caplog.text
    assert "for: watching sweeps." in caplog.text


def test_a_connection_whose_query_has_no_answer_holds_no_end(
    tmp_path: Path, silence: Silence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Closing it waits for the thread that asked."""
    engine = open_database(sqlite_url(tmp_path / "service.db"))

    def hold() -> None:
        with held(engine):
            monkeypatch.setattr(Hold, "close", silence)

    assert seconds(hold) < 10.0
    assert silence.asked.is_set()
    engine.dispose()


def test_what_a_call_returns_or_raises_is_passed_on() -> None:
    assert within(lambda: 5) == 5
    with pytest.raises(ZeroDivisionError):
        within(lambda: 1 // 0)


@pytest.mark.parametrize(("query", "own"), [
    ("", {}),
    ("?connect_timeout=3&tcp_user_timeout=0", {"connect_timeout": "3", "tcp_user_timeout": "0"}),
])  # fmt: skip
def test_a_server_that_falls_silent_is_noticed_and_the_operator_says_when(query: str, own: dict[str, str]) -> None:
    asked: list[dict[str, Any]] = []

    def note(_dialect: Any, _record: Any, _arguments: Any, parameters: dict[str, Any]) -> None:
        asked.append(dict(parameters))
        raise OperationalError(None, None, Exception("none is asked"))

    event.listen(Engine, "do_connect", note)
    try:
        with pytest.raises(CannotRunError, match="none is asked"):
            open_database(f"postgresql://ann@127.0.0.1/none{query}")
    finally:
        event.remove(Engine, "do_connect", note)
    patience = {
        "connect_timeout": 10, "keepalives_idle": 15, "keepalives_interval": 5, "keepalives_count": 3,
        "tcp_user_timeout": 20_000,
    }  # fmt: skip
    assert {name: asked[0].get(name) for name in patience} == patience | own

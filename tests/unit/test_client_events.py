"""Events as the client gives them: in order, none twice, across lost connections; and waiting for an end."""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from cutting_proxy import cutting_proxy
from live_service import Live, live, wait_until  # noqa: F401 (a fixture)
from services import FAKE
from sqlalchemy.exc import OperationalError
from sweep_folders import make_sweep_folder

from policies.errors import CannotRunError, NotFoundError, TuneJobsError
from tests.narrowing import present
from tune_jobs.client import Client, Event, NoServiceError, UnavailableError, event_stream
from tune_jobs.client import client as client_module
from tune_jobs.client.event_stream import Parser
from tune_jobs.service.views import SweepView

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_stream, "_WAIT_S", 0.02)
    monkeypatch.setattr(client_module, "_POLL_S", 0.02)


class Listener:
    """Follows events in a thread."""

    def __init__(self, events: Iterator[Event]) -> None:
        self.found: list[Event] = []
        self.error: Exception | None = None
        self._events = events
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self) -> None:
        try:
            for event in self._events:
                self.found.append(event)
        except TuneJobsError as error:
            self.error = error

    def of(self, kind: str) -> list[Any]:
        return [event.data for event in list(self.found) if event.kind == kind]

    def wait_for(self, is_there: Callable[[], object]) -> None:
        wait_until(lambda: is_there() or self.error)
        assert self.error is None, self.error


# -- the format


def test_bytes_become_events_however_they_are_cut() -> None:
    text = (
        'retry: 10\n\nid: a-1\n\n: comment\nid: a-2\nevent: status\ndata: {"note": "one\u2028line\x85é"}\n\n'
        "event: x\r\ndata: [1,\r\ndata: 2]\r\n\r\nid: a-4\ndata: 3\n\nevent: half\ndata: 1\n"
    ).encode()
    for size in (1, 2, 3, 7, len(text)):
        parser = Parser()
        found = [event for begin in range(0, len(text), size) for event in parser.feed(text[begin : begin + size])]
        assert found == [
            Event("status", {"note": "one\u2028line\x85é"}, "a-2"), Event("x", [1, 2], "a-2"),
            Event("message", 3, "a-4"),
        ]  # fmt: skip
        assert parser.last_id == "a-4"
    parser = Parser()
    assert parser.last_id is None
    list(parser.feed(b"id: b-7\n\n"))
    assert parser.last_id == "b-7"


# -- following


def test_changes_come_as_they_happen_and_end_with_the_sweep(live: Live) -> None:
    make_sweep_folder(live.storage / "done")
    with Client(live.url) as client:
        listener = Listener(client.events("done"))
        listener.wait_for(lambda: listener.of("status"))
        client.change("done", note="a\u2028b")
        listener.wait_for(lambda: [item for item in listener.of("status") if item["note"] == "a\u2028b"])
        client.delete("done")
        listener.wait_for(lambda: listener.of("deleted"))
        listener.thread.join(20)
        assert not listener.thread.is_alive()
        assert listener.error is None


def test_after_a_lost_connection_what_came_meanwhile_comes_once(live: Live) -> None:
    make_sweep_folder(live.storage / "done")
    with Client(live.url) as direct, cutting_proxy(live.url) as proxy, Client(proxy.url) as client:
        listener = Listener(client.events("done"))
        listener.wait_for(lambda: listener.of("status"))
        log = live.service.watching.sweep("done").log
        for number in range(2):
            proxy.is_away = True
            proxy.cut_all()
            for text in (f"early {number}", f"note {number}"):
                known = log.last_id
                direct.change("done", note=text)
                # The service looks from time to time, on a busy machine more rarely: each note is to be seen.
                wait_until(lambda: log.last_id != known)  # noqa: B023
            proxy.is_away = False
            listener.wait_for(lambda: listener.of("status")[-1]["note"] == f"note {number}")  # noqa: B023
        assert [item["note"] for item in listener.of("status")] == ["", "early 0", "note 0", "early 1", "note 1"]
        assert len({event.id for event in listener.found}) == len(listener.found)
        direct.delete("done")
        listener.thread.join(20)


def test_connections_that_end_in_quiet_are_no_absence(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    """Proxies end streams after a while, however long a sweep waits for its turn; each time the service was there."""
    monkeypatch.setattr("tune_jobs.service.http.event_stream.HEARTBEAT_S", 0.05)
    make_sweep_folder(live.storage / "done")
    with Client(live.url) as direct, cutting_proxy(live.url) as proxy, Client(proxy.url, patience_s=1.0) as client:
        listener = Listener(client.events("done"))
        listener.wait_for(lambda: listener.of("status"))
        for _ in range(6):
            proxy.cut_all()
            time.sleep(0.5)
        assert listener.error is None
        direct.change("done", note="later")
        listener.wait_for(lambda: listener.of("status")[-1]["note"] == "later")
        direct.delete("done")
        listener.thread.join(20)


def test_events_that_are_known_no_more_are_told(live: Live) -> None:
    make_sweep_folder(live.storage / "done")
    with Client(live.url) as client:
        assert next(client.events("done", last_id="another-5")).kind == "reset"


def test_a_service_that_stays_away_is_told(live: Live) -> None:
    make_sweep_folder(live.storage / "done")
    with cutting_proxy(live.url) as proxy, Client(proxy.url, patience_s=0.3) as client:
        events = client.events("done")
        assert next(events).kind == "status"
        proxy.is_away = True
        proxy.cut_all()
        with pytest.raises(CannotRunError, match=proxy.url):
            list(events)
        proxy.is_away = False
    with Client(live.url) as client, pytest.raises(NotFoundError, match="'none'"):
        next(client.events("none"))


def test_the_list_is_followed_beyond_a_deletion(live: Live) -> None:
    make_sweep_folder(live.storage / "done")
    with Client(live.url) as client:
        listener = Listener(client.events())
        wait_until(lambda: live.service.watching.num_watchers == 1)
        client.delete("done")
        listener.wait_for(lambda: listener.of("deleted"))
        client.submit(FAKE, name="mine")
        listener.wait_for(lambda: listener.of("sweeps"))
        assert listener.of("sweeps")[0]["sweeps"][0]["name"] == "mine"


def test_leaving_a_stream_ends_its_connection(live: Live) -> None:
    make_sweep_folder(live.storage / "done")
    with Client(live.url) as client:
        events = client.events("done")
        next(events)
        assert live.service.watching.num_watchers == 1
        events.close()  # type: ignore[attr-defined]
        wait_until(lambda: live.service.watching.num_watchers == 0)


def test_as_many_as_may_watch_already_is_told(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    make_sweep_folder(live.storage / "done")
    monkeypatch.setattr(live.service.watching, "max_watchers", 0)
    with Client(live.url) as client, pytest.raises(CannotRunError, match="clients watch already"):
        next(client.events("done"))


# -- waiting


def test_a_job_is_followed_to_its_end(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SweepView, "interval_s", 0.05)
    queue = live.service.queue
    with Client(live.url) as client:
        job = client.submit(FAKE, name="mine").job
        seen: list[str] = []
        for _, now in client.job_events(job):
            if not seen or seen[-1] != now.state:
                seen.append(now.state)
                if now.state == "waiting":
                    assert queue.claim(8.0) is not None
                elif now.state == "running":
                    queue.end(job.id, "completed", "all is well")
        assert seen == ["waiting", "running", "ended"]
        assert now.message == "all is well"
        # One that has ended already.
        assert [found.outcome for _, found in client.job_events(job)] == ["completed"]


def test_a_database_that_is_away_for_a_moment_is_no_end(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is wrong with the sweep, and whoever follows it for hours meets a database that is started again."""
    monkeypatch.setattr(SweepView, "interval_s", 0.05)
    queue, away = live.service.queue, threading.Event()
    looked: list[str] = []

    def look(name: str) -> Callable[..., Any]:
        real = getattr(queue, name)

        def found(*arguments: Any, **how: Any) -> Any:
            if away.is_set():
                looked.append(name)
                raise OperationalError(None, None, Exception("it is being started again"))
            return real(*arguments, **how)

        return found

    for name in ("job", "jobs"):
        monkeypatch.setattr(queue, name, look(name))
    with Client(live.url) as client:
        job = client.submit(FAKE, name="mine").job
        away.set()
        back = threading.Timer(1.0, away.clear)
        back.start()
        queue.request_stop("mine")
        assert present(client.wait("mine", job=job, timeout_s=20).job).outcome == "cancelled"
        assert "job" in looked
        back.join()
        away.set()
        client._patience_s = 0.5
        with pytest.raises(UnavailableError, match="database can't be used just now"):
            client.wait("mine", job=job)
        with pytest.raises(UnavailableError, match="database can't be used just now"):
            list(client.events("mine"))
    away.clear()


def test_waiting_ends_with_the_sweep(live: Live) -> None:
    with Client(live.url) as client:
        job = client.submit(FAKE, name="mine").job
        with pytest.raises(CannotRunError, match=r"has not ended after 0\.1 s"):
            client.wait("mine", timeout_s=0.1)
        client.stop("mine")
        assert client.wait("mine", timeout_s=20).state == "created"
        assert client.wait("mine", job=job, timeout_s=20).name == "mine"
        store = live.service.storage.sweep("mine")
        store.write_record(store.read_record().model_copy(update={"state": "running"}))
        with store.lock(), pytest.raises(CannotRunError, match="has not ended"):
            client.wait("mine", timeout_s=0.1)
        with pytest.raises(NotFoundError):
            client.wait("none")
    with Client("http://127.0.0.1:1") as client, pytest.raises(NoServiceError):
        client.wait("mine")

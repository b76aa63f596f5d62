"""Many who listen at once, and those who are too slow: what they take is bounded, and no one else waits for them."""

import gc
import resource
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest
from live_service import Live, serving, wait_until
from starlette.types import Message, Scope
from sweep_folders import make_sweep_folder

from tune_jobs.service import serve
from tune_jobs.service.config import Limits
from tune_jobs.service.event_log import EventLog
from tune_jobs.service.http import event_stream
from tune_jobs.service.http.event_stream import EventStream
from tune_jobs.service.watching import Watching

CROWD = 1_000
SCOPE: Scope = {"type": "http", "method": "GET", "path": "/", "headers": []}


# -- slow clients


class Client:
    """Takes what it is sent, each part after some time.

    Args:
        seconds: How long it takes; None: it never does.
    """

    def __init__(self, seconds: float | None) -> None:
        self.seconds = seconds
        self.bodies: list[bytes] = []
        self.has_left = anyio.Event()

    async def receive(self) -> Message:
        await self.has_left.wait()
        return {"type": "http.disconnect"}

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.body":
            await (anyio.sleep_forever() if self.seconds is None else anyio.sleep(self.seconds))
            self.bodies.append(message["body"])


@pytest.fixture
def watching() -> Watching:
    """Two places, and nothing to be watched."""
    nothing: Any = None
    return Watching(nothing, nothing, nothing, nothing, 2)


def test_a_client_that_takes_nothing_is_dropped_after_a_while(
    watching: Watching, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_stream, "SLOW_S", 0.3)
    log = EventLog("a")

    async def listen() -> float:
        client, began = Client(None), anyio.current_time()
        with anyio.fail_after(20):
            await EventStream(watching, log, None)(SCOPE, client.receive, client.send)
        assert client.bodies == []
        return anyio.current_time() - began

    assert 0.25 < anyio.run(listen) < 5.0
    assert (watching.num_watchers, log.num_listeners) == (0, 0)


def test_a_client_that_is_slow_but_not_too_slow_gets_all(watching: Watching, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_stream, "SLOW_S", 5.0)
    # So that what is there is sent in several parts, each of them in time.
    monkeypatch.setattr("tune_jobs.service.event_log.CHUNK_BYTES", 10)
    log = EventLog("a")
    log.add([("status", {"number": number}) for number in range(3)])
    first = log.last_id
    log.add([("status", {"number": number}) for number in range(3, 6)])
    log.end()

    async def listen() -> bytes:
        client = Client(0.1)
        with anyio.fail_after(20):
            await EventStream(watching, log, first)(SCOPE, client.receive, client.send)
        return b"".join(client.bodies)

    assert anyio.run(listen).count(b'"number"') == 3
    assert watching.num_watchers == 0


def test_the_service_drops_the_slow_before_the_system_does() -> None:
    # Whoever is dropped by the system has held a place, and what was to be sent, until then.
    assert event_stream.SLOW_S < serve._UNREAD_MS / 1_000
    # A phone that goes from one cell to the next is no reason.
    assert event_stream.SLOW_S > 5.0


# -- crowds


@pytest.fixture
def many_files() -> Iterator[None]:
    """Enough descriptors for both ends of each connection."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = 2 * CROWD + 500
    if hard != resource.RLIM_INFINITY and hard < wanted:
        pytest.skip(f"a process may open {hard} files here")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, wanted), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def ask_for_events(live: Live) -> socket.socket:
    host = live.url.removeprefix("http://")
    made = socket.create_connection(("127.0.0.1", int(host.rpartition(":")[2])), timeout=60)
    made.sendall(f"GET /api/v1/sweeps/mine/events HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
    return made


def status_of(connection: socket.socket) -> int:
    found = b""
    while b"\r\n" not in found:
        more = connection.recv(64)
        assert more, "it was closed without an answer"
        found += more
    return int(found.split()[1])


def memory_bytes() -> int:
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


@pytest.mark.usefixtures("many_files")
@pytest.mark.parametrize("places", [Limits().watchers, CROWD])
def test_a_thousand_idle_streams(tmp_path: Path, places: int) -> None:
    make_sweep_folder(tmp_path / "sweeps" / "mine")
    with serving(tmp_path / "sweeps", watchers=places) as live:
        assert live.get("/sweeps/mine").status_code == 200
        threads, before = threading.active_count(), memory_bytes()
        connections = [ask_for_events(live) for _ in range(CROWD)]
        try:
            statuses = [status_of(connection) for connection in connections]
            assert (statuses.count(200), statuses.count(429)) == (places, CROWD - places)
            assert live.service.watching.num_watchers == places
            # About 50 kB each, of which most is this test's own end and the server's buffers.
            assert memory_bytes() - before < 150e6
            # One that looks at the sweep, and those of the pool that answers requests.
            assert threading.active_count() - threads < 50
            assert live.get("/sweeps").status_code == 200
        finally:
            for connection in connections:
                connection.close()
        wait_until(lambda: live.service.watching.num_watchers == 0)
        again = ask_for_events(live)
        assert status_of(again) == 200
        again.close()

"""Connections that send no whole request are closed after a while; those that are answered or a little slow stay."""

import resource
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from live_service import Live, serving
from sweep_folders import make_sweep_folder

from tune_jobs.service import connections
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.serve import Server, serve

HEAD_S = 1.0
PATIENCE_S = 20.0
HEAD = "GET /healthz HTTP/1.1\r\nHost: {host}\r\n"


@pytest.fixture
def live(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Live]:
    """A service that gives a head one second, with a sweep."""
    monkeypatch.setattr(connections, "HEAD_S", HEAD_S, raising=False)
    make_sweep_folder(tmp_path / "sweeps" / "mine")
    with serving(tmp_path / "sweeps") as made:
        yield made


def host_of(live: Live) -> str:
    return live.url.removeprefix("http://")


def say(live: Live, text: str) -> socket.socket:
    made = socket.create_connection(("127.0.0.1", int(host_of(live).rpartition(":")[2])), timeout=PATIENCE_S)
    made.sendall(text.format(host=host_of(live)).encode())
    return made


def heard(connection: socket.socket) -> bytes:
    """What comes next; nothing: it was closed."""
    return connection.recv(65_536)


def answered(connection: socket.socket) -> bytes:
    found = b""
    while b"ok" not in found:
        more = heard(connection)
        assert more, "it was closed without an answer"
        found += more
    return found


@pytest.mark.parametrize("text", ["", "GET", HEAD, "POST /api/v1/plans HTTP/1.1\r\nHost: {host}\r\nContent-Le"])
def test_one_that_sends_no_whole_head_is_closed(live: Live, text: str) -> None:
    began = time.monotonic()
    with say(live, text) as connection:
        assert heard(connection) == b""
    assert time.monotonic() - began > 0.9 * HEAD_S


@pytest.mark.parametrize("text", ["G", HEAD])
def test_one_that_sends_a_byte_now_and_then_is_closed(live: Live, text: str) -> None:
    with say(live, text) as connection:
        connection.settimeout(0.1)
        deadline, is_open = time.monotonic() + PATIENCE_S, True
        while is_open and time.monotonic() < deadline:
            try:
                connection.sendall(b"x")
                is_open = heard(connection) != b""
            except TimeoutError:
                continue
            except ConnectionError:
                is_open = False
    assert not is_open


def test_one_whose_second_head_is_not_whole_is_closed(live: Live) -> None:
    with say(live, HEAD + "\r\n") as connection:
        assert answered(connection).startswith(b"HTTP/1.1 200 ")
        # That it had sent one in time is no reason to wait for the next for good.
        connection.sendall(HEAD.format(host=host_of(live)).encode())
        assert heard(connection) == b""


def test_many_that_send_nothing_leave_room_for_the_others(live: Live) -> None:
    silent = [say(live, "" if number % 2 else HEAD) for number in range(100)]
    for connection in silent:
        with connection:
            assert heard(connection) == b""
    assert len(live.server.server_state.connections) == 0
    assert live.get("/me").status_code == 200


def test_a_head_that_takes_less_is_answered_and_so_is_the_next(live: Live) -> None:
    with say(live, HEAD) as connection:
        for _ in range(3):
            time.sleep(0.6 * HEAD_S)
            connection.sendall(b"\r\n")
            assert answered(connection).startswith(b"HTTP/1.1 200 ")
            connection.sendall(HEAD.format(host=host_of(live)).encode())


def test_a_stream_in_which_nothing_happens_goes_on(live: Live) -> None:
    with live.events("/sweeps/mine/events") as reader:
        assert not reader.has_ended.wait(3 * HEAD_S)
        assert (reader.status, reader.error) == (200, None)


def test_a_body_has_the_time_of_a_body(live: Live) -> None:
    text = "POST /api/v1/plans HTTP/1.1\r\nHost: {host}\r\nContent-Type: application/json\r\nContent-Length: 2\r\n\r\n"
    with say(live, text) as connection:
        time.sleep(2 * HEAD_S)
        connection.sendall(b"{")
        time.sleep(HEAD_S)
        connection.sendall(b"}")
        assert heard(connection).startswith(b"HTTP/1.1 422 ")


def test_a_request_that_is_answered_slowly_is_answered(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    see, waiting = live.service.statuses.see, threading.Event()

    def slow(name: str) -> object:
        waiting.wait(3 * HEAD_S)
        return see(name)

    monkeypatch.setattr(live.service.statuses, "see", slow)
    assert live.get("/sweeps/mine/spec").status_code == 200


def test_while_it_serves_a_process_may_open_as_many_files_as_the_system_allows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    soft, hard = before = resource.getrlimit(resource.RLIMIT_NOFILE)
    lowered = min(256 if soft == resource.RLIM_INFINITY else soft, 256)
    during: list[tuple[int, int]] = []
    monkeypatch.setattr(Server, "run", lambda *_, **__: during.append(resource.getrlimit(resource.RLIMIT_NOFILE)))
    resource.setrlimit(resource.RLIMIT_NOFILE, (lowered, hard))
    try:
        serve(ServiceConfig(storage=tmp_path, port=0, spare_idle_s=0))
        assert resource.getrlimit(resource.RLIMIT_NOFILE) == (lowered, hard)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert during == [(65_536 if hard == resource.RLIM_INFINITY else min(hard, 65_536), hard)]


@pytest.mark.parametrize(
    ("at_most", "raised_to"), [(1_000_000, [65_536]), (61_440, [10_240]), (10_240, [10_240]), (1_000, [])]
)
@pytest.mark.parametrize("refusal", [ValueError("current limit exceeds maximum limit"), OSError(1, "No")])
def test_a_system_that_allows_less_than_it_says_is_taken_as_it_is(
    at_most: int, raised_to: list[int], refusal: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As macOS does, whose `ulimit -Hn` is unlimited."""
    limits = [(256, resource.RLIM_INFINITY)]

    def set_limits(_: int, asked: tuple[int, int]) -> None:
        if asked[0] > at_most:
            raise refusal
        limits.append(asked)

    monkeypatch.setattr(resource, "getrlimit", lambda _: limits[-1])
    monkeypatch.setattr(resource, "setrlimit", set_limits)
    with connections.many_files():
        assert [soft for soft, _ in limits[1:]] == raised_to
    assert limits[-1] == limits[0]

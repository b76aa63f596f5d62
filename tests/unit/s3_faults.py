"""A proxy between obstore and the S3 server of the tests, which does by rule what networks and servers do at times.

It runs in the process of the test. Requests are passed on as they are; the server does not check their signatures.
"""

import contextlib
import http.client
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler
from urllib.parse import parse_qs, unquote, urlsplit

import pytest
from s3_server import s3_endpoint

from tune_jobs.store.objects import asked, clients, object_trial, outbox, owners, trial_state
from tune_jobs.store.objects.object_sweep import ObjectSweep
from tune_jobs.store.objects.url import ObjectUrl


@dataclass
class Request:
    """A request that came here."""

    method: str
    key: str
    """Of what is read or written; of a listing, the prefix."""
    is_list: bool
    authorization: str

    @property
    def kind(self) -> str:
        return "LIST" if self.is_list else self.method


@dataclass
class Rule:
    """What is done with the next requests of a kind.

    Args:
        act: status (answered so and not passed on), before and after (the connection is closed before or after the
            request was passed on), torn (half of the answer's body), slow, or stale (listed without some keys).
        kinds: Methods, or LIST, by a regular expression.
        keys: Keys by a regular expression, which is searched.
        times: How often.
        skip: How many such requests are let through before.
        status: The answer's status.
        body: The answer's body.
        delay_s: Seconds that the request waits.
    """

    act: str
    kinds: str = ".*"
    keys: str = ""
    times: int = 1
    skip: int = 0
    status: int = 503
    body: str = "<Error><Code>SlowDown</Code><Message>Please reduce your request rate.</Message></Error>"
    delay_s: float = 0.0
    then: Callable[[], object] = lambda: None
    """Called when the request has been passed on, before it is answered; of `before`, instead of that."""

    def takes(self, request: Request) -> bool:
        """Whether it is for a request, which counts."""
        if not self.times or not re.fullmatch(self.kinds, request.kind) or not re.search(self.keys, request.key):
            return False
        if self.skip:
            self.skip -= 1
            return False
        self.times -= 1
        return True


class Faults:
    """The proxy, at `endpoint`; it counts in `requests` what came."""

    def __init__(self) -> None:
        upstream = urlsplit(s3_endpoint())
        self.upstream = (str(upstream.hostname), int(upstream.port or 80))
        self.requests: list[Request] = []
        self.rules: list[Rule] = []
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._listener: socket.socket | None = None
        self.port = 0
        self.back()

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def rule(self, act: str, **settings: object) -> Rule:
        """Add a rule; the first one that takes a request is followed."""
        made = Rule(act, **settings)  # type: ignore[arg-type]
        self.rules.append(made)
        return made

    def clear(self) -> None:
        """Forget rules and requests."""
        self.rules.clear()
        self.requests.clear()

    def counts(self) -> dict[str, int]:
        """How many requests of each kind came."""
        kinds = [request.kind for request in self.requests]
        return {kind: kinds.count(kind) for kind in sorted(set(kinds))}

    def away(self) -> None:
        """Refuse connections, and close those that there are."""
        listener, self._listener = self._listener, None
        if listener is not None:
            with contextlib.suppress(OSError):
                listener.shutdown(socket.SHUT_RDWR)
            listener.close()
        with self._lock:
            for connection in self._open:
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)

    def back(self) -> None:
        """Answer again, at the same port."""
        listener = socket.create_server(("127.0.0.1", self.port), backlog=128)
        self.port = listener.getsockname()[1]
        self._listener = listener
        threading.Thread(target=self._accept, args=(listener,), daemon=True).start()

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                connection, address = listener.accept()
            except OSError:
                return
            with self._lock:
                self._open.add(connection)
            threading.Thread(target=self._serve, args=(connection, address), daemon=True).start()

    def _serve(self, connection: socket.socket, address: object) -> None:
        with contextlib.suppress(OSError, http.client.HTTPException):
            _Handler(connection, address, self)  # type: ignore[arg-type]
        with self._lock:
            self._open.discard(connection)
        connection.close()

    def took(self, request: Request) -> Rule | None:
        """Note a request, and return the rule for it."""
        with self._lock:
            self.requests.append(request)
            return next((rule for rule in self.rules if rule.takes(request)), None)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Faults  # type: ignore[assignment]
    disable_nagle_algorithm = True

    def log_request(self, *_: object) -> None:
        pass

    def do_any(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        address = urlsplit(self.path)
        query = parse_qs(address.query)
        is_list = "list-type" in query
        key = query.get("prefix", [""])[0] if is_list else unquote(address.path)
        request = Request(self.command, key, is_list, self.headers.get("Authorization", ""))
        rule = self.server.took(request) or Rule("", times=0)
        time.sleep(rule.delay_s)
        if rule.act == "before":
            rule.then()
            self._hang_up()
            return
        if rule.act == "status":
            rule.then()
            self._answer(rule.status, [("Content-Type", "application/xml")], rule.body.encode())
            return
        upstream = http.client.HTTPConnection(*self.server.upstream, timeout=30)
        upstream.request(self.command, self.path, body, dict(self.headers.items()))
        answer = upstream.getresponse()
        found = answer.read()
        upstream.close()
        rule.then()
        if rule.act == "after":
            self._hang_up()
        elif rule.act == "stale":
            kept = re.sub(rb"<Contents>(?:(?!</Contents>).)*</Contents>", b"", found, flags=re.DOTALL)
            self._answer(answer.status, answer.getheaders(), kept)
        else:
            self._answer(answer.status, answer.getheaders(), found, torn=rule.act == "torn")

    do_GET = do_PUT = do_POST = do_DELETE = do_HEAD = do_any  # noqa: N815 (as http.server calls them)

    def _hang_up(self) -> None:
        self.close_connection = True

    def _answer(self, status: int, headers: list[tuple[str, str]], body: bytes, *, torn: bool = False) -> None:
        self.send_response_only(status)
        left_out = {"transfer-encoding", "connection"} | (set() if self.command == "HEAD" else {"content-length"})
        for name, value in headers:
            if name.lower() not in left_out:
                self.send_header(name, value)
        if self.command != "HEAD":
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body[: len(body) // 2] if torn else body)
        if torn:
            self._hang_up()


@pytest.fixture
def faults(monkeypatch: pytest.MonkeyPatch) -> Iterator[Faults]:
    """A proxy of the test's own; all that waits has little patience."""
    # Milliseconds would do, but for machines that do much else.
    monkeypatch.setattr(clients, "PATIENCE_S", 2.0)
    monkeypatch.setattr(outbox, "_FIRST_PAUSE_S", 0.02)
    monkeypatch.setattr(outbox, "_LONGEST_PAUSE_S", 0.05)
    monkeypatch.setattr(owners, "_LOOK_EVERY_S", 0.0)
    monkeypatch.setattr(trial_state, "_LOOK_EVERY_S", 0.0)
    monkeypatch.setattr(asked, "_EVERY_S", 0.0)
    monkeypatch.setattr(trial_state, "_RESULTS_AFTER_S", 0.02)
    monkeypatch.setattr(trial_state, "_CHECKPOINTS_AFTER_S", 0.0)
    monkeypatch.setattr(object_trial, "_RUNNING_AFTER_S", 0.0)
    made = Faults()
    yield made
    made.clear()


@pytest.fixture
def url(faults: Faults) -> ObjectUrl:
    return ObjectUrl("s3", "sweeps", f"{secrets.token_hex(4)}/mine", {"endpoint": faults.endpoint})


Opened = Callable[[], ObjectSweep]
"""Opens the sweep as another process does."""


@pytest.fixture
def opened(url: ObjectUrl) -> Opened:
    """The sweep as another process opens it."""
    return lambda: ObjectSweep(url)


def iterations(opened: Opened) -> list[int]:
    """The results that another process sees."""
    return [record.iteration for record in opened().trial("t0000").read_iterations()]

"""A service that listens on a port of 127.0.0.1, in a thread, and what reads its events as a browser does."""

import contextlib
import dataclasses
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx2
import pytest

from tune_jobs.service.access.gate import opened_gate
from tune_jobs.service.config import Limits, ServiceConfig
from tune_jobs.service.http.app import make_app
from tune_jobs.service.serve import Server, listening_socket
from tune_jobs.service.service import Service, opened


@dataclasses.dataclass(frozen=True)
class Live:
    """A service, and where it is."""

    service: Service
    server: Server
    thread: threading.Thread
    url: str

    @property
    def storage(self) -> Path:
        return Path(self.service.config.storage)

    def get(self, path: str, **options: Any) -> httpx2.Response:
        return httpx2.get(f"{self.url}/api/v1{path}", timeout=30, **options)

    def events(self, path: str, last_id: str | None = None) -> "EventReader":
        return EventReader(f"{self.url}/api/v1{path}", last_id)


@contextlib.contextmanager
def serving(
    storage: Path | str,
    *,
    require_token: bool = False,
    certificate: tuple[Path, Path] | None = None,
    own_folder: Path | None = None,
    **limits: Any,
) -> Iterator[Live]:
    """Serve a storage folder, with TLS if there is a certificate and its key; its queue stands still."""
    chain, key = certificate or (None, None)
    config = ServiceConfig(
        storage=storage, port=0, spare_idle_s=0, limits=Limits(**limits), drain_s=1.0, require_token=require_token,
        tls_certificate=chain, tls_key=key, own_folder=own_folder,
    )  # fmt: skip
    started = threading.Event()
    with listening_socket(config) as listening, _idle(config) as service:
        server = Server(service, config, make_app(service), started.set)
        thread = threading.Thread(target=server.run, args=([listening],), daemon=True)
        url = f"{'http' if certificate is None else 'https'}://127.0.0.1:{listening.getsockname()[1]}"
        thread.start()
        assert started.wait(30)
        try:
            yield Live(service, server, thread, url)
        finally:
            server.should_exit = True
            thread.join(30)
            assert not thread.is_alive()


@contextlib.contextmanager
def serving_a_viewer(storage: Path, name: str) -> Iterator[tuple[Live, str]]:
    """Serve a storage folder to those with a token alone; yields it, and the token of a viewer of this name."""
    with opened_gate(ServiceConfig(storage=storage)) as gate:
        _, secret = gate.tokens.make(name, "viewer")
    with serving(storage, require_token=True) as closed:
        yield closed, secret


@contextlib.contextmanager
def _idle(config: ServiceConfig) -> Iterator[Service]:
    with pytest.MonkeyPatch.context() as patch:
        # Sweeps that seem to be running are the tests' own: no driver is to be started for them.
        patch.setattr("tune_jobs.service.supervisor.Supervisor.start", lambda _: None)
        with opened(config) as service:
            yield service


@pytest.fixture
def live(tmp_path: Path) -> Iterator[Live]:
    with serving(tmp_path / "sweeps") as made:
        yield made


@dataclasses.dataclass(frozen=True)
class Event:
    kind: str
    data: Any
    id: str


class EventReader:
    """Reads server-sent events in a thread, for as long as a block.

    Attributes:
        events: What has come.
        comments: How many comments have.
        status: Of the answer; None: there is none yet.
        has_ended: Set when the stream is at its end.
        error: How it ended, if not well.
    """

    def __init__(self, url: str, last_id: str | None = None) -> None:
        self.events: list[Event] = []
        self.comments = 0
        self.status: int | None = None
        self.error: Exception | None = None
        self.last_id = last_id
        self.has_begun, self.has_ended = threading.Event(), threading.Event()
        self._client = httpx2.Client(timeout=httpx2.Timeout(30, read=60))
        headers = {} if last_id is None else {"Last-Event-ID": last_id}
        self._request = self._client.build_request("GET", url, headers=headers)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._answer: httpx2.Response | None = None

    def __enter__(self) -> Self:
        self._thread.start()
        assert self.has_begun.wait(30)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # Another thread waits in a read, which closing the connection ends only with a shutdown.
        if self._answer is not None and not self.has_ended.is_set():
            with contextlib.suppress(OSError):
                self._answer.extensions["network_stream"].get_extra_info("socket").shutdown(socket.SHUT_RDWR)
        self._thread.join(30)
        self._client.close()

    def _read(self) -> None:
        try:
            self._answer = self._client.send(self._request, stream=True)
            self.status = self._answer.status_code
            self.has_begun.set()
            fields: dict[str, str] = {}
            for line in self._answer.iter_lines():
                if line.startswith(":"):
                    self.comments += 1
                elif line:
                    name, _, value = line.partition(": ")
                    fields[name] = value
                else:
                    self.last_id = fields.get("id", self.last_id)
                    if "data" in fields:
                        self.events.append(Event(fields["event"], json.loads(fields["data"]), self.last_id or ""))
                    fields = {}
        except (httpx2.HTTPError, OSError) as error:
            self.error = error
        finally:
            self.has_begun.set()
            self.has_ended.set()

    def of(self, kind: str) -> list[Event]:
        return [event for event in list(self.events) if event.kind == kind]

    def wait_for(self, is_there: Callable[[], object], timeout_s: float = 20.0) -> None:
        wait_until(is_there, timeout_s)


def wait_until(is_there: Callable[[], object], timeout_s: float = 20.0) -> None:
    """Wait for something that others do; it fails where it takes too long."""
    deadline = time.monotonic() + timeout_s
    while not is_there():
        assert time.monotonic() < deadline, "it never was so"
        time.sleep(0.02)

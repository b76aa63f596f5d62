"""A head that speaks Ray's Jobs API as its dashboard does, and runs nothing: a test says what becomes of a job."""

import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar, cast

import pytest

from tune_jobs.ray_tune import known_clusters

SUBMIT = "/api/jobs/"


class Head(ThreadingHTTPServer):
    """Attributes: what a test sets, and what was sent.

    token: What requests have to show; None: nothing.
    shown: What requests had as Authorization, one after the other.
    jobs: The answers about jobs, by id.
    on_submit: Called with a submission; returns what becomes of the job, or raises what the head refuses it with.
    """

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.address = f"http://127.0.0.1:{self.server_address[1]}"
        self.token: str | None = None
        self.shown: list[str | None] = []
        self.jobs: dict[str, dict[str, Any]] = {}
        self.submitted: list[dict[str, Any]] = []
        self.packages: dict[str, bytes] = {}
        self.stopped: list[str] = []
        self.on_submit: Callable[[dict[str, Any]], dict[str, Any]] = lambda body: {"status": "RUNNING"}

    def begin(self, body: dict[str, Any]) -> None:
        self.jobs[body["submission_id"]] = self.on_submit(body)
        self.submitted.append(body)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    names: ClassVar[dict[str, str]] = {"version": "4", "ray_version": "2.60.0", "ray_commit": "0", "session_name": "s"}

    @property
    def head(self) -> Head:
        return cast("Head", self.server)

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post)

    def do_PUT(self) -> None:
        self._answer(self._put)

    def _answer(self, of: Callable[[bytes], tuple[int, str]]) -> None:
        content = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        shown = self.headers.get("Authorization")
        self.head.shown.append(shown)
        if self.head.token is None or shown == f"Bearer {self.head.token}":
            status, text = of(content)
        elif shown is None:
            status, text = 401, "Unauthorized: Missing authentication token"
        else:
            status, text = 403, "Forbidden: Invalid authentication token"
        body = text.encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _get(self, _: bytes) -> tuple[int, str]:
        if self.path == "/api/version":
            return 200, json.dumps(self.names)
        name = self.path.rpartition("/")[2]
        if self.path.startswith("/api/packages/gcs/"):
            return (200, "") if name in self.head.packages else (404, f"Package gcs://{name} does not exist")
        if name in self.head.jobs:
            return 200, json.dumps({"type": "SUBMISSION", "submission_id": name, **self.head.jobs[name]})
        return 404, f"Job {name} does not exist"

    def _put(self, content: bytes) -> tuple[int, str]:
        self.head.packages[self.path.rpartition("/")[2]] = content
        return 200, ""

    def _post(self, content: bytes) -> tuple[int, str]:
        if self.path == SUBMIT:
            body = json.loads(content)
            try:
                self.head.begin(body)
            except ValueError as error:
                return 500, f"Traceback (most recent call last):\n  ...\nValueError: {error}\n"
            return 200, json.dumps({"job_id": body["submission_id"], "submission_id": body["submission_id"]})
        self.head.stopped.append(self.path.split("/")[-2])
        return 200, json.dumps({"stopped": True})

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 (the name that is overridden)
        pass


@pytest.fixture
def head(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Head]:
    for name in (
        "RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", "RAY_ADDRESS", "RAY_API_SERVER_ADDRESS",
        "TUNE_JOBS_JOB",
    ):  # fmt: skip
        monkeypatch.delenv(name, raising=False)
    # Nobody has sent a job anywhere yet, and what a test sends is not kept for this machine's user.
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(known_clusters, "_noted", set())
    server = Head()
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    yield server
    server.shutdown()
    server.server_close()
    thread.join()

"""The service's log: JSON, one object a line, that says what each line is about, and no secret in either format."""

import contextlib
import json
import logging
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from fastapi.testclient import TestClient
from live_service import Live, live, wait_until  # noqa: F401 (fixture)
from service_access import bearer, make_token
from services import FAKE, client, service  # noqa: F401 (fixtures)
from sweep_folders import make_sweep_folder

from policies.errors import CannotRunError, SpecError
from tune_jobs.service import logs
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.database.opening import open_database, sqlite_url
from tune_jobs.service.job_files import JobFiles
from tune_jobs.service.service import Service
from tune_jobs.service.telling import told_target

# ruff: noqa: F811 - fixtures are named as arguments

TOKEN = "tune-jobs_0123abcd_" + "A" * 43


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """One kind of database is enough here."""
    return sqlite_url(tmp_path / "service.db")


class Lines(logging.Handler):
    """Keeps what a format makes of all records."""

    def __init__(self, made: logging.Formatter) -> None:
        super().__init__()
        self.setFormatter(made)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(self.format(record))

    @property
    def objects(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.lines]

    def requests(self) -> list[dict[str, Any]]:
        return [line for line in self.objects if line["logger"] == logs.ACCESS]


@contextlib.contextmanager
def logged(log_format: logs.LogFormat, secrets: tuple[str, ...] = ()) -> Iterator[Lines]:
    """What is logged in the block, in a format."""
    handler, root, access = (
        Lines(logs.formatter(log_format, secrets=secrets)),
        logging.getLogger(),
        logging.getLogger(logs.ACCESS),
    )
    before = root.level, access.level
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    access.setLevel(logging.INFO)
    try:
        yield handler
    finally:
        root.removeHandler(handler)
        root.setLevel(before[0])
        access.setLevel(before[1])


def test_a_request_is_a_line_with_its_route_status_duration_and_caller(live: Live) -> None:
    make_sweep_folder(live.storage / "done")
    secret = live.service.gate.tokens.make("ann", "viewer")[1]
    with logged("json") as handler:
        live.get("/sweeps/done/trials/t0001", headers=bearer(secret))
        httpx2.post(f"{live.url}/api/v1/sweeps/done/stop", headers=bearer(secret))
        live.get("/nowhere")
        wait_until(lambda: len(handler.requests()) == 3)
    seen, refused, missing = handler.requests()
    assert (seen["method"], seen["route"], seen["status"]) == ("GET", "/api/v1/sweeps/{name}/trials/{trial_id}", 200)
    assert (seen["caller"], seen["sweep"], seen["trial"], seen["level"]) == ("ann", "done", "t0001", "INFO")
    assert 0 < seen["duration_s"] < 30
    assert (refused["route"], refused["status"], refused["caller"]) == ("/api/v1/sweeps/{name}/stop", 403, "ann")
    assert (missing["route"], missing["status"], missing["caller"]) == ("none", 404, "local")
    assert "sweep" not in missing
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", seen["time"])


@pytest.mark.parametrize(
    "given",
    ["7f2c", "a" * 128, "01J9Z:edge/7+x=", None, "a" * 129, "", "-x", "a b", 'x"y', "x;y", "<b>", "é"],
)
def test_the_id_of_a_request_is_taken_if_it_is_sane_else_made(live: Live, given: str | None) -> None:
    headers = {} if given is None else {b"X-Request-ID": given.encode("latin-1")}
    with logged("json") as handler:
        answer = httpx2.get(f"{live.url}/healthz", headers=headers)
        wait_until(handler.requests)
    told = answer.headers["x-request-id"]
    if given in ("7f2c", "a" * 128, "01J9Z:edge/7+x="):
        assert told == given
    else:
        assert re.fullmatch("[0-9a-f]{32}", told)
    assert handler.requests()[0]["request_id"] == told


def test_an_id_that_comes_twice_is_none(live: Live) -> None:
    answer = httpx2.get(f"{live.url}/healthz", headers=[("X-Request-ID", "a"), ("X-Request-ID", "b")])
    assert answer.headers["x-request-id"] not in ("a", "b", "a, b")


def test_what_a_route_logs_names_the_request(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("it broke")

    monkeypatch.setattr(live.service.queue, "jobs", broken)
    for log_format in ("json", "text"):
        with logged(log_format) as handler:
            answer = live.get("/jobs", headers={"X-Request-ID": "7f2c"})
            wait_until(lambda: any("it broke" in line for line in handler.lines))
            # What the server itself logs of a request is there before it takes the next one.
            live.get("/schema")
        assert (answer.status_code, answer.headers["x-request-id"]) == (500, "7f2c")
        (line,) = [line for line in handler.lines if "it broke" in line]
        if log_format == "json":
            told = json.loads(line)
            assert (told["request_id"], told["level"], told["caller"]) == ("7f2c", "ERROR", "local")
            assert "Traceback" in told["exception"]
            assert "RuntimeError: it broke" in told["exception"]
        else:
            assert line.splitlines()[0].endswith("Unexpected RuntimeError [request 7f2c]")


def test_what_the_supervisor_logs_names_sweep_job_and_owner(client: TestClient, service: Service) -> None:
    client.post("/api/v1/sweeps", json={"spec": FAKE, "name": "mine"})
    store = service.storage.sweep("mine")
    record = store.read_record()
    how = {"seconds": 0, "error": "it broke"}
    store.write_record(record.model_copy(update={"spec": record.spec | {"hyperparams": how}}))

    def has_ended() -> bool:
        service.supervisor._look()
        return service.queue.jobs()[0].state == "ended"

    with logged("json") as handler:
        wait_until(has_ended, 60)
    told = [line for line in handler.objects if line["logger"].endswith("supervisor")]
    assert len(told) == 2
    assert all((line["sweep"], line["job"], line["owner"]) == ("mine", 1, "local") for line in told)
    # The driver's own log, which is kept as it has failed.
    said = JobFiles(service.config.folder, service.queue.jobs()[0].uid).last_lines().splitlines()
    assert "Attempt 1 is run by process" in said[0]
    assert said[0].endswith("[job 1, sweep mine]")
    assert said[-1].endswith("Attempt 1 has ended: failed. [job 1, sweep mine]")


# -- secrets


@pytest.mark.parametrize("log_format", ["json", "text"])
def test_no_secret_is_in_a_line_or_its_traceback(log_format: logs.LogFormat, tmp_path: Path) -> None:
    config = ServiceConfig(
        storage=tmp_path, database="postgresql://ann:p%40ss%2Fword@db.example/queue",
        webhook_secret="whsec_aHVzaGh1c2g=",
        webhooks=("https://hooks.example.org/services/T0/B0/XyZzY?key=1",),
    )  # fmt: skip
    said = [
        TOKEN, f"Authorization: Bearer {TOKEN}", config.database, "p@ss/word", "p%40ss%2Fword", config.webhook_secret,
        config.webhooks[0], "/services/T0/B0/XyZzY?key=1", "http://bob:hush-hush@proxy.example/",
        "postgresql+psycopg://ann:p@ss/word@db.example",
    ]  # fmt: skip
    hidden = ("A" * 43, "p@ss", "p%40ss", "aHVzaGh1c2g", "XyZzY", "hush-hush")
    with logged(log_format, config.secrets) as handler:
        for text in said:
            logging.getLogger("x").warning("It says %s", text, extra={"caller": text})
            try:
                int(str(text))
            except ValueError:
                logging.getLogger("x").exception("It failed.")
    assert len(handler.lines) == 2 * len(said)
    assert [(secret, line) for line in handler.lines for secret in hidden if secret in line] == []
    # What is no secret stays.
    assert any("tune-jobs_0123abcd_***" in line for line in handler.lines)
    assert any("db.example" in line for line in handler.lines)


def test_json_stays_json_whatever_is_said() -> None:
    # Not by a logger: pytest keeps what these say, and its processes cannot send half a character to one another.
    handler = Lines(logs.formatter("json"))
    said = logging.LogRecord("x", logging.WARNING, __file__, 1, 'a\nb\x00 \ud800 "%s" é', ({"a": object()},), None)
    said.__dict__.update(sweep="a\nb", job=3)
    handler.emit(said)
    (line,) = handler.lines
    assert "\n" not in line
    told = json.loads(line)
    assert (told["sweep"], told["job"]) == ("a\nb", 3)
    assert told["message"].startswith("a\nb\x00")


def test_a_short_text_is_not_taken_out_everywhere() -> None:
    assert logs.Redaction(["", "ab"])("abc") == "abc"
    assert logs.Redaction(["secret", "secret-longer"])("a secret-longer, a secret") == "a ***, a ***"


def test_a_webhook_is_told_by_its_host_and_a_command_by_its_name() -> None:
    assert told_target("https://hooks.example.org:8443/services/T0?key=1") == "https://hooks.example.org:8443"
    assert told_target("https://ann:hush@example.org") == "https://example.org"
    assert told_target('command:["/opt/bin/tell", "--key", "hush"]') == "the command tell"


@pytest.mark.parametrize(
    "url", ["https://", "http://[", "https://a.example:port/", "https://a.example:0/", "https://a.example/a b",
            "https://a.example/\n", "https://ann:hush-hush@a.example/", "https://ann@a.example/"],
)  # fmt: skip
def test_a_webhook_that_could_never_be_told_is_refused_at_the_start(url: str, tmp_path: Path) -> None:
    with pytest.raises(SpecError) as caught:
        ServiceConfig(storage=tmp_path, webhooks=(url,))
    assert "hush-hush" not in str(caught.value)


@pytest.mark.parametrize(
    "url", ["postgresql://ann:hush-hush@db:port/x", "mysql://ann:hush-hush@db/x", "://ann:hush-hush@x"]
)
def test_a_database_url_that_is_wrong_is_told_without_its_password(url: str) -> None:
    with pytest.raises(CannotRunError) as caught:
        open_database(url)
    assert "hush-hush" not in str(caught.value)


def test_what_is_written_to_the_database_is_in_no_error(tmp_path: Path) -> None:
    engine = open_database(sqlite_url(tmp_path / "service.db"))
    with engine.begin() as connection, pytest.raises(Exception) as caught:  # noqa: PT011
        connection.exec_driver_sql("INSERT INTO tokens (id) VALUES (?)", ("hush-hush",))
    assert "hush-hush" not in str(caught.value)
    engine.dispose()


# -- a process


class Server:
    """`tune-jobs serve` in a process of its own."""

    def __init__(self, folder: Path, *options: str, **variables: str) -> None:
        folder.mkdir()
        self.storage, self.log = folder / "sweeps", folder / "stderr"
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-c", "from tune_jobs.cli.commands import main; main()", "serve", "--port", "0",
                 "--storage", str(self.storage), "--spare-idle", "0", "--json", *options],
                stdout=subprocess.PIPE, stderr=log, env=os.environ | variables, text=True,
            )  # fmt: skip
        assert self.process.stdout is not None
        self.url = json.loads(self.process.stdout.readline())["url"]

    def end(self) -> str:
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(60) == 0
        return self.log.read_text()


@pytest.mark.parametrize("log_format", ["json", "text"])
def test_a_server_logs_in_its_format_from_its_begin_to_its_end(tmp_path: Path, log_format: str) -> None:
    folder = tmp_path / "place"
    server = Server(
        folder, "--log-format", log_format, "--webhook", "http://127.0.0.1:1/services/XyZzY-hush",
        TUNE_JOBS_WEBHOOK_SECRET="webhook-hush",
    )  # fmt: skip
    try:
        secret = make_token(server.storage, "ann", "admin")
        headers = bearer(secret) | {"X-Request-ID": "7f2c"}
        assert httpx2.get(f"{server.url}/api/v1/me", headers=headers).headers["x-request-id"] == "7f2c"
        assert httpx2.get(f"{server.url}/api/v1/me", headers=bearer(secret[:-1] + "!")).status_code == 401
        assert httpx2.post(f"{server.url}/api/v1/login", json={"token": secret}).status_code == 200
        spec = FAKE | {"stop": {"num_env_steps": 512}, "engine": "nothing"}
        httpx2.post(f"{server.url}/api/v1/sweeps", json={"spec": spec}, headers=headers)
    finally:
        said = server.end()
    for hidden in (secret, secret[-20:-1], "XyZzY-hush", "webhook-hush"):
        assert hidden not in said
    if log_format == "json":
        lines = [json.loads(line) for line in said.splitlines()]
        assert all({"time", "level", "logger", "message"} <= line.keys() for line in lines)
        assert "uvicorn.error" in {line["logger"] for line in lines}
        requests = [line for line in lines if line["logger"] == logs.ACCESS]
        assert [line["status"] for line in requests] == [200, 401, 200, 422]
        assert (requests[0]["caller"], requests[0]["request_id"]) == ("ann", "7f2c")
    else:
        assert re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} INFO uvicorn\.error: ", said)
        assert logs.ACCESS not in said


def test_an_error_that_ends_a_thread_is_a_line_too() -> None:
    with logged("json") as handler:
        thread = threading.Thread(target=lambda: 1 / 0, name="counting")
        before, threading.excepthook = threading.excepthook, logs._log_thread
        try:
            thread.start()
            thread.join()
        finally:
            threading.excepthook = before
    (line,) = handler.objects
    assert "counting" in line["message"]
    assert "ZeroDivisionError" in line["exception"]


def test_the_time_is_told_in_utc() -> None:
    with logged("json") as handler:
        logging.getLogger("x").warning("now")
    assert handler.objects[0]["time"][:16] == time.strftime("%Y-%m-%dT%H:%M", time.gmtime())

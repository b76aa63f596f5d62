"""The command line with --server where what it has begun can't be followed: it says what was begun, and where it is."""

import errno
import http.server
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from client_fixtures import alone, soon  # noqa: F401 (fixtures)
from fake_sweeps import RunCommand
from live_service import serving
from sweep_folders import make_sweep_folder
from test_client_runs import Queue, during
from test_service_downloads import make_finished

from tests.narrowing import present
from tune_jobs.cli import remote_runs
from tune_jobs.cli.server import Server
from tune_jobs.client import Client
from tune_jobs.client.asking import Asking
from tune_jobs.client.problems import TooManyError
from tune_jobs.service.jobs import Job

JOB = Job(
    id=7, uid="u", sweep="my ten", verb="drive", arguments={}, owner="ann", priority=0, num_cpus=1.0, state="waiting",
    outcome=None, message=None, finish_failed=None, num_attempts=0, stop_requested=False, submitted_at=1.0,
    started_at=None, ended_at=None,
)  # fmt: skip
COMMANDS = {"launch": ("launch", "cartpole-ppo"), "extend": ("extend", "my ten", "--num-samples", "2")}


class StandIn(http.server.ThreadingHTTPServer):
    """What takes a submission, and then answers otherwise than a client hopes."""

    def __init__(self, how: str) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.how = how
        self.posts: list[str] = []
        self.url = f"http://127.0.0.1:{self.server_port}"


class _Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: StandIn

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers["Content-Length"]))
        self.server.posts.append(self.path)
        job = JOB.model_dump(mode="json")
        self._say(201, job if self.path.endswith("/extend") else {"sweep": JOB.sweep, "job": job})

    def do_GET(self) -> None:
        if self.server.how == "lost":
            self.close_connection = True
            return
        if self.server.how == "refused":
            self._problem(401, "The token has expired.")
        elif self.path.endswith("/jobs/7"):
            self._say(200, JOB.model_copy(update={"state": "ended", "outcome": "completed"}).model_dump(mode="json"))
        elif self.path.endswith("/records"):
            self._problem(500, "Unexpected ValueError; the service's log has the traceback.")
        elif self.path.endswith("/events"):
            self._problem(429, "200 clients watch already; no more may.")
        else:
            self._problem(404, "There is no such sweep.")

    def _problem(self, status: int, detail: str) -> None:
        self._say(status, {"status": status, "detail": detail}, "application/problem+json")

    def _say(self, status: int, body: Any, media_type: str = "application/json") -> None:
        content = json.dumps(body).encode()
        self.send_response(status)
        self.send_header("Content-Type", media_type)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(params=["lost", "refused"])
def stand_in(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[StandIn]:
    monkeypatch.setitem(present(Asking.__init__.__kwdefaults__), "patience_s", 0.1)
    with StandIn(request.param) as made:
        worker = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        worker.start()
        yield made
        made.shutdown()
        worker.join(30)


@pytest.mark.parametrize("as_json", [False, True], ids=["text", "json"])
@pytest.mark.parametrize("verb", COMMANDS)
def test_what_was_begun_is_named_where_it_can_not_be_followed(
    run: RunCommand, stand_in: StandIn, verb: str, *, as_json: bool
) -> None:
    result = run("--server", stand_in.url, *COMMANDS[verb], *(["--json"] if as_json else []))
    assert result.exit_code == 5
    assert len(stand_in.posts) == 1
    program = f"tune-jobs --server {stand_in.url}"
    hint = f"It goes on there: see {program} status 'my ten', and stop it with: {program} stop 'my ten'"
    begin = f"my ten was submitted to {stand_in.url}, and is no longer followed: The "
    if as_json:
        document = json.loads(result.stdout)
        assert (document["exit_code"], document["hint"]) == (5, hint)
        assert document["error"].startswith(begin)
    told = " ".join(result.stderr.split())
    assert begin in told
    assert hint in told


@pytest.mark.parametrize("stand_in", ["whole"], indirect=True)
def test_what_has_ended_is_named_where_its_result_can_not_be_had(
    run: RunCommand, stand_in: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = Client(stand_in.url).job(7)
    monkeypatch.setattr(remote_runs, "_followed", lambda *_: ended)
    result = run("--server", stand_in.url, "launch", "cartpole-ppo", "--json")
    document = json.loads(result.stdout)
    assert document["error"] == (
        f"Sweep my ten has ended at {stand_in.url}: completed. Its result can't be had: Unexpected ValueError; the "
        "service's log has the traceback."
    )
    assert document["hint"] == f"See what came of it: tune-jobs --server {stand_in.url} status 'my ten'"


def test_where_too_many_watch_a_sweep_is_waited_for(
    run: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tune_jobs.client.client._POLL_S", 0.02)
    with serving(tmp_path / "sweeps", watchers=0) as live:
        make_finished(live.storage / "mine")
        with Client(live.url) as client, pytest.raises(TooManyError, match="clients watch already"):
            next(client.events("mine"))
        queue = Queue(live)
        monkeypatch.setattr(queue, "watched", lambda: None)
        worker = during(lambda: queue.finish("mine", message="It has no film."))
        result = run("--server", live.url, "resume", "mine", "--json")
        worker.join(30)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["notes"] == ["It has no film."]
    lines = result.stderr.splitlines()
    assert lines[:2] == ["mine: waits for its turn", "mine: too many watch sweeps there; its end is waited for"]
    assert "env steps" in lines[-1]


def test_why_a_sweep_has_no_best_policy_is_the_reason_that_its_job_gives(run: RunCommand, tmp_path: Path) -> None:
    why = "The environment MyEnv-v0 raised ValueError: bad state, while the policy was confirmed."
    with serving(tmp_path / "sweeps") as live:
        for message, notes in (
            (f"No best policy: {why}", []),
            (f"1 of 4 trials failed. No report: no space. No best policy: {why}",
             ["1 of 4 trials failed. No report: no space."]),
        ):  # fmt: skip
            if not notes:
                make_sweep_folder(live.storage / "mine")
            worker = during(lambda said=message: Queue(live).finish("mine", message=said, finish_failed=True))
            result = run("--server", live.url, "resume", "mine", "--json", "--progress", "none")
            worker.join(30)
            document = json.loads(result.stdout)
            assert (result.exit_code, document["why_no_best"], document["notes"]) == (3, why, notes)
        worker = during(lambda: Queue(live).finish("mine", finish_failed=True))
        said = json.loads(run("--server", live.url, "resume", "mine", "--json").stdout)["why_no_best"]
        worker.join(30)
    assert (
        said == "Sweep mine has ended, and has no best policy.\nResume it: then one is chosen, or it is said why not."
    )


def test_how_to_resume_is_said_though_nobody_reads_the_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C ends the reader of a pipe, too."""

    def print_outcome(*_: Any, **__: Any) -> None:
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    monkeypatch.setattr("tune_jobs.cli.output.print_outcome", print_outcome)
    sweep = make_sweep_folder(tmp_path / "mine", iterations=1).read_record()
    result = {"sweep": sweep, "trials": [], "best": None, "why_no_best": None, "folder": "", "artifacts": {}}
    ended = {"notes": [], "interrupted": True, "exit_code": 130}
    assert remote_runs._show(result | ended, Server("http://localhost:1", None, None, ""), as_json=False) == 130
    assert "resume mine" in capsys.readouterr().err

"""Ray's token goes to clusters that the user has named, and to no address that only a sweep's record names."""

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from fake_jobs import Head, head
from sweep_folders import make_sweep_folder

from analysis.records import JobRecord, SweepState
from policies.errors import CannotRunError
from tune_jobs.cli.commands import cli
from tune_jobs.ray_tune import known_clusters
from tune_jobs.ray_tune.jobs import JobsApi
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import detached, verbs
from tune_jobs.sweeps.own_job import environment_of

__all__ = ["head"]

TOKEN = "Bearer very-secret"
SWEEP = "env: CartPole-v1\nalgorithm: ppo\nstop: {num_env_steps: 2000}\n"


@pytest.fixture(autouse=True)
def token(head: Head, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "very-secret")
    monkeypatch.setattr(detached, "_POLL_S", 0.02)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text(SWEEP)


@pytest.fixture
def got(head: Head, tmp_path: Path) -> SweepStore:
    """A sweep of somebody else, whose record says that a job of that address is about to run it."""
    store = make_sweep_folder(tmp_path / "s" / "got")
    job = JobRecord(id="got-12345678", address=f"{head.address}/x", place="")
    store.write_record(store.read_record().model_copy(update={"job": job, "state": "created"}))
    head.jobs[job.id] = {"status": "PENDING"}
    return store


def run(*words: str) -> Result:
    return CliRunner().invoke(cli, (*words, "--storage", "s"))


def state(name: str) -> str:
    return str(json.loads(run("status", name, "--json").stdout)["job"]["state"])


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave what the file has, as the next command does, which is another process."""
    monkeypatch.setattr(known_clusters, "_noted", set())


def test_who_looks_at_a_sweep_that_somebody_wrote_shows_no_token(head: Head, got: SweepStore) -> None:
    told = run("status", "got")
    assert told.exit_code == 0, told.output
    words = " ".join(told.stdout.split())
    assert f"not asked. Only the sweep's record names {head.address}/x, so Ray's token is not sent there" in words
    assert f"set RAY_API_SERVER_ADDRESS={head.address}/x" in words
    for verb in ("attach", "stop"):
        refused = run(verb, "got")
        assert refused.exit_code == 5, refused.output
        assert "Only the sweep's record names" in refused.stderr
        assert f"set RAY_API_SERVER_ADDRESS={head.address}/x" in refused.stderr
    with pytest.raises(CannotRunError, match="Only the sweep's record names"):
        verbs.stop(got.folder)
    assert head.shown == []


def test_a_sweep_that_goes_on_elsewhere_asks_only_the_cluster_that_is_named(
    head: Head, got: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Head() as other:
        threading.Thread(target=other.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        other.on_submit = lambda body: {"status": "SUCCEEDED"}
        done = run("resume", "got", "--address", other.address, "--detach")
        other.shutdown()
    assert done.exit_code == 0, done.output
    assert (head.shown, set(other.shown)) == ([], {TOKEN})


def test_without_a_token_a_records_cluster_is_asked(
    head: Head, got: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RAY_AUTH_MODE")
    assert state("got") == "pending"
    assert head.shown == [None]


@pytest.mark.parametrize("name", ["RAY_API_SERVER_ADDRESS", "RAY_ADDRESS"])
def test_a_cluster_that_rays_variables_name_is_asked(
    head: Head, got: SweepStore, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv(name, f"{head.address}/")
    assert state("got") == "pending"
    assert run("stop", "got").exit_code == 0
    assert (set(head.shown), head.stopped) == ({TOKEN}, ["got-12345678"])


def test_so_is_the_one_that_the_command_names(head: Head, got: SweepStore) -> None:
    again = run("resume", "got", "--address", head.address, "--detach")
    assert (again.exit_code, "is about to run sweep got" in again.stderr) == (5, True), again.output
    assert head.shown == [TOKEN]


def test_so_is_the_one_whose_job_asks(head: Head, got: SweepStore, monkeypatch: pytest.MonkeyPatch) -> None:
    own = JobRecord(id="other-1", address=head.address)
    monkeypatch.setenv("TUNE_JOBS_JOB", environment_of(own)["TUNE_JOBS_JOB"])
    assert state("got") == "pending"


def test_what_was_launched_is_told_of_stopped_and_gone_on_with_later(
    head: Head, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    head.token = "very-secret"
    head.on_submit = lambda body: {"status": "SUCCEEDED"}
    assert run("launch", "mine.yaml", "--address", head.address, "--detach").exit_code == 0
    forget(monkeypatch)
    kept = tmp_path / "state" / "tune-jobs" / "clusters"
    assert (kept.read_text(), kept.stat().st_mode & 0o777) == (f"{head.address}\n", 0o600)
    (job,) = head.jobs
    assert state("mine") == "ended"
    head.jobs[job] = {"status": "PENDING"}
    assert state("mine") == "pending"
    assert run("stop", "mine").exit_code == 0
    assert head.stopped == [job]
    head.jobs[job] = {
        "status": "FAILED",
        "message": "exit code 5, last logs:\nerror: No room.\n",
        "driver_exit_code": 5,
    }
    told = run("attach", "mine")
    assert (told.exit_code, "No room." in told.stderr) == (5, True), told.output
    assert run("resume", "mine", "--address", f"{head.address}/", "--detach").exit_code == 0
    assert kept.read_text() == f"{head.address}\n"


def test_where_nothing_can_be_kept_a_launch_is_followed_to_its_end(
    head: Head, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "state").touch()
    head.on_submit = lambda body: {"status": "SUCCEEDED"}
    assert run("launch", "mine.yaml", "--address", head.address, "--detach").exit_code == 0
    assert state("mine") == "ended"
    forget(monkeypatch)
    assert state("mine").startswith("not asked. ")


@pytest.mark.parametrize("mode", [0o620, 0o602])
def test_a_list_that_others_may_write_is_not_believed(head: Head, got: SweepStore, tmp_path: Path, mode: int) -> None:
    kept = tmp_path / "state" / "tune-jobs" / "clusters"
    kept.parent.mkdir(parents=True)
    kept.write_text(f"{head.address}\n")
    kept.chmod(0o600)
    assert state("got") == "pending"
    kept.chmod(mode)
    assert state("got").startswith("not asked. ")


@pytest.mark.parametrize(
    ("one", "other", "is_same"),
    [
        ("http://head:8265", "http://HEAD:8265/", True),
        ("http://head:8265", "HTTP://head:8265/behind/a/proxy", True),
        ("https://head", "https://head:443", True),
        ("http://head:8265", "https://head:8265", False),
        ("http://head:8265", "http://head:8266", False),
        ("http://head:8265", "http://head", False),
        ("http://head:8265", "http://head.elsewhere:8265", False),
        ("http://[::1]:8265", "http://[::1]:8265/", True),
        # The port of the dashboard is in none of them.
        ("http://head:8265", "ray://head:8265", False),
        ("http://head:8265", "head:8265", False),
        ("http://head:8265", "auto", False),
        ("http://head:8265", "", False),
        ("http://", "http://", False),
    ],
)
def test_an_address_is_named_by_scheme_host_and_port(
    one: str, other: str, is_same: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", other)
    assert known_clusters.is_named(one) is is_same
    monkeypatch.delenv("RAY_ADDRESS")
    assert known_clusters.is_named(one, (other,)) is is_same


@pytest.fixture
def elsewhere(head: Head) -> Iterator[str]:
    """What answers there sends everybody to the head."""

    class Sent(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(307)
            self.send_header("Location", f"{head.address}{self.path}")
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002 (the name that is overridden)
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Sent) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def test_a_redirect_is_not_followed(head: Head, elsewhere: str) -> None:
    with JobsApi(elsewhere) as api, pytest.raises(CannotRunError, match="it answers 307"):
        api.ray_version()
    assert head.shown == []


@pytest.mark.parametrize("found", ["completed", "interrupted"])
def test_a_sweep_that_was_driven_is_not_running_whoever_its_record_names(
    head: Head, got: SweepStore, found: SweepState
) -> None:
    got.write_record(got.read_record().model_copy(update={"state": found}))
    result = run("stop", "got")
    assert (result.exit_code, result.stdout.strip()) == (0, "got is not running.")
    assert head.shown == []

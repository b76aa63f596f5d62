"""The command line with --server: sweeps that are run there, and followed to their end."""

import json
import threading
from pathlib import Path
from typing import Any

import pytest
from client_fixtures import alone, soon  # noqa: F401 (fixtures)
from cutting_proxy import cutting_proxy
from fake_sweeps import RunCommand
from live_service import Live, live, serving, wait_until  # noqa: F401 (a fixture)
from sweep_folders import extend_by_leaders, make_sweep_folder
from test_service_downloads import make_finished

from tune_jobs.cli import remote_runs
from tune_jobs.store.sweep_store import SweepStore

# ruff: noqa: F811 - fixtures are named as arguments

YAML = "env: CartPole-v1\nalgorithm: ppo\nspace: {lr: {loguniform: [1e-4, 1e-2]}}\nnum_samples: 3\nconfirm: none\n"


class Queue:
    """Does what the processes of a service do, while a command follows."""

    def __init__(self, live: Live) -> None:
        self.live = live
        self.jobs = live.service.queue

    def wait_for_job(self) -> int:
        wait_until(lambda: self.jobs.jobs("waiting"))
        return self.jobs.jobs("waiting")[0].id

    def watched(self) -> None:
        wait_until(lambda: self.live.service.watching.num_watchers > 0)

    def finish(
        self,
        name: str,
        outcome: Any = "completed",
        message: str | None = None,
        until: Any = lambda: True,
        *,
        finish_failed: bool | None = None,
    ) -> None:
        number = self.wait_for_job()
        self.watched()
        assert self.jobs.claim(8.0) is not None
        wait_until(until)
        store = SweepStore(self.live.storage / name)
        if outcome == "completed" and not store.has_best():
            record = store.read_record()
            store.write_record(record.model_copy(update={"state": "completed"}))
        self.jobs.end(number, outcome, message, finish_failed=finish_failed)


def during(what: Any) -> threading.Thread:
    thread = threading.Thread(target=what, daemon=True)
    thread.start()
    return thread


def test_a_launch_is_followed_to_its_end(
    run: RunCommand, live: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote_runs, "_LINE_INTERVAL_S", 0.0)
    (tmp_path / "poles.yaml").write_text(YAML)
    queue = Queue(live)
    said: list[str] = []
    follow = remote_runs._followed

    def followed(client: Any, job: Any, say: Any) -> Any:
        def say_both(line: str) -> None:
            said.append(line)
            say(line)

        return follow(client, job, say_both)

    monkeypatch.setattr(remote_runs, "_followed", followed)
    worker = during(lambda: queue.finish("poles", message="It can't be drawn.", until=lambda: "poles: runs" in said))
    result = run("--server", live.url, "launch", "poles.yaml", "--set", "num_samples=2")
    worker.join(30)
    assert result.exit_code == 3, result.output
    lines = result.stderr.splitlines()
    assert lines[0] == "poles: waits for its turn"
    assert "poles: runs" in lines
    assert said == lines
    assert "0 %, 0 env steps" in lines[-1]
    assert "no best policy: It can't be drawn." in result.stdout
    assert f"{live.url}/#/sweeps/poles" in result.stdout
    assert live.service.storage.sweep("poles").read_record().spec["num_samples"] == 2


def test_a_resumed_sweep_ends_with_the_result_of_one_that_runs_here(run: RunCommand, live: Live) -> None:
    make_finished(live.storage / "mine")
    worker = during(lambda: Queue(live).finish("mine"))
    result = run("--server", live.url, "resume", "mine", "--json", "--progress", "none")
    worker.join(30)
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    document = json.loads(result.stdout)
    assert document.keys() == {
        "folder", "sweep", "trials", "best", "why_no_best", "artifacts", "interrupted", "notes", "finish_failed",
        "exit_code",
    }  # fmt: skip
    assert document["best"]["checkpoint"]["trial_id"] == "t0003"
    assert document["artifacts"]["report"] == f"{live.url}/api/v1/sweeps/mine/report/"
    assert live.get("/sweeps/mine/films/after_gif").status_code == 200
    assert document["artifacts"].keys() == {
        "policy", "before_mp4", "after_mp4", "after_gif", "before_after_mp4", "report",
    }  # fmt: skip


@pytest.mark.parametrize(("finish_failed", "code"), [(True, 3), (False, 0), (None, 0)])
def test_a_film_that_failed_there_is_told_as_one_that_failed_here(
    run: RunCommand, live: Live, finish_failed: bool | None, code: int
) -> None:
    """Nobody knows it of a job that an older version ran."""
    make_finished(live.storage / "mine")
    told = Queue(live)
    worker = during(lambda: told.finish("mine", message="It has no film.", finish_failed=finish_failed))
    result = run("--server", live.url, "resume", "mine", "--json", "--progress", "none")
    worker.join(30)
    assert result.exit_code == code, result.output
    document = json.loads(result.stdout)
    assert (document["exit_code"], document["finish_failed"]) == (code, code == 3)
    assert document["best"]["checkpoint"]["trial_id"] == "t0003"
    assert document["notes"] == ["It has no film."]


def test_a_policy_of_before_is_not_the_result_of_an_extension(run: RunCommand, live: Live) -> None:
    store = make_finished(live.storage / "mine")

    def extended() -> bool:
        extend_by_leaders(store)
        return True

    worker = during(lambda: Queue(live).finish("mine", until=extended))
    result = run("--server", live.url, "extend", "mine", "--num-samples", 1, "--json", "--progress", "none")
    worker.join(30)
    assert result.exit_code == 3, result.output
    document = json.loads(result.stdout)
    assert (document["best"], document["finish_failed"]) == (None, True)
    assert "chosen before the sweep was trained on" in document["why_no_best"]
    assert "policy" not in document["artifacts"]


def test_what_stops_a_sweep_there_ends_its_command_here(run: RunCommand, live: Live) -> None:
    make_sweep_folder(live.storage / "mine")
    queue = Queue(live)
    worker = during(lambda: queue.finish("mine", "stopped"))
    result = run("--server", live.url, "extend", "mine", "--num-samples", "2")
    worker.join(30)
    assert result.exit_code == 130
    assert result.stderr.splitlines()[-1].endswith(f"tune-jobs --server {live.url} resume mine")
    worker = during(lambda: queue.finish("mine", "failed", "ValueError: no CPU is left"))
    result = run("--server", live.url, "replicate", "mine", "--json")
    worker.join(30)
    assert result.exit_code == 1
    assert "no CPU is left" in json.loads(result.stdout)["error"]


def test_failed_trials_are_retried_if_there_are_any(run: RunCommand, live: Live) -> None:
    store = make_sweep_folder(live.storage / "mine")
    queue = Queue(live)
    for status, verb in (("completed", "drive"), ("failed", "retry")):
        trial = store.trial("t0000")
        trial.write_record(trial.read_record().model_copy(update={"status": status, "error": "it broke"}))
        # A sweep whose record is the same has not changed, for a service.
        store.write_record(store.read_record())
        worker = during(lambda: queue.finish("mine"))
        result = run("--server", live.url, "resume", "mine", "--retry-failed")
        worker.join(30)
        assert result.exit_code == 3, result.output
        assert live.service.queue.jobs()[-1].verb == verb
    again = f"`tune-jobs --server {live.url} resume mine --retry-failed` runs it again."
    assert again in " ".join(result.stdout.split())


def test_ctrl_c_stops_following_and_not_the_sweep(
    run: RunCommand, live: Live, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "poles.yaml").write_text(YAML)

    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(remote_runs, "_followed", interrupted)
    result = run("--server", live.url, "launch", "poles.yaml", "--json")
    assert result.exit_code == 130
    assert f"Stop it with: tune-jobs --server {live.url} stop poles" in result.stderr
    assert json.loads(result.stdout)["exit_code"] == 130
    assert [job.state for job in live.service.queue.jobs()] == ["waiting"]
    assert "stops after" in run("--server", live.url, "stop", "poles").stdout
    assert "not running" in run("--server", live.url, "stop", "poles").stdout


def test_ctrl_c_after_the_end_says_that_it_has_ended(
    run: RunCommand, live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_finished(live.storage / "mine")

    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(remote_runs, "_result", interrupted)
    worker = during(lambda: Queue(live).finish("mine"))
    result = run("--server", live.url, "resume", "mine")
    worker.join(30)
    assert result.exit_code == 130
    last = result.stderr.splitlines()[-1]
    assert f"Sweep mine has ended at {live.url}: completed." in last
    assert last.endswith(f"tune-jobs --server {live.url} status mine")


def test_following_goes_on_where_the_connection_was_lost(run: RunCommand, live: Live) -> None:
    make_sweep_folder(live.storage / "mine")
    with cutting_proxy(live.url) as proxy:
        queue = Queue(live)

        def work() -> None:
            queue.wait_for_job()
            queue.watched()
            proxy.cut_all()
            queue.finish("mine")

        worker = during(work)
        result = run("--server", proxy.url, "resume", "mine")
        worker.join(30)
        assert result.exit_code == 3, result.output
        assert result.stderr.startswith("mine: waits for its turn\n")
        assert len([request for request in proxy.requests if b"/events " in request]) <= 2

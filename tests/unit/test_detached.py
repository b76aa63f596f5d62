"""A sweep that a job drives: what is written and sent, what is undone if it fails, and what its records show then."""

import contextlib
import json
import shlex
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from fake_jobs import Head, head
from sweep_folders import make_sweep_folder

from analysis.records import JobRecord
from policies.errors import CannotRunError
from tune_jobs.cli.commands import cli
from tune_jobs.store.opening import is_same_place
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import detached, verbs
from tune_jobs.sweeps.attach import _Look
from tune_jobs.sweeps.own_job import environment_of, job_of, note_own_job

__all__ = ["head"]

SWEEP = "env: CartPole-v1\nalgorithm: ppo\nstop: {num_env_steps: 2000}\n"
NO_STORAGE = "Node 10.0.0.2 cannot read the storage."


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(detached, "_POLL_S", 0.02)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text(SWEEP)


def run(*words: str) -> Result:
    return CliRunner().invoke(cli, words)


def launch(head: Head, *words: str) -> Result:
    return run("launch", "mine.yaml", "--storage", "s", "--address", head.address, *words)


def failed(message: str, code: int | None) -> dict[str, Any]:
    return {"status": "FAILED", "message": message, "driver_exit_code": code}


@contextlib.contextmanager
def driven(folder: Path, ending: str, *, after_s: float = 0.3) -> Iterator[None]:
    """Drive a sweep in a thread until it ends with a state; the lock of a file is held by what opened it, here too."""
    store = SweepStore(folder)
    held = threading.Event()

    def drive() -> None:
        with store.lock():
            store.write_record(store.read_record().model_copy(update={"state": "running"}))
            held.set()
            time.sleep(after_s)
            store.write_record(store.read_record().model_copy(update={"state": ending}))

    thread = threading.Thread(target=drive)
    thread.start()
    held.wait(10)
    yield
    thread.join()


def test_a_launch_leaves_a_sweep_and_a_job_that_resumes_it(head: Head, tmp_path: Path) -> None:
    # Ray calls a job failed whose driver ended with 3, as that of a sweep with failed trials does.
    head.on_submit = lambda body: failed("Job entrypoint command failed with exit code 3", 3)
    done = launch(head, "--detach", "--json")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    store, sent = SweepStore(tmp_path / "s" / "mine"), head.submitted[0]
    assert (told["sweep"], told["job"], told["address"]) == ("mine", sent["submission_id"], head.address)
    assert told["commands"]["attach"] == "tune-jobs attach mine --storage s"
    assert shlex.split(sent["entrypoint"]) == ["tune-jobs", "resume", str(store.folder), "--address", "auto"]
    assert store.read_record().job == JobRecord(id=told["job"], address=head.address, place=str(store.folder))
    assert launch(head, "--detach", "--name", "patient", "--wait-for-nodes", "90").exit_code == 0
    sent_words = shlex.split(head.submitted[1]["entrypoint"])
    assert sent_words[3:] == ["--wait-for-nodes", "90.0", "--address", "auto"]
    # No module of the user's own is named: nothing travels.
    assert set(sent["runtime_env"]) == {"env_vars"}
    assert sent["metadata"]["sweep"] == "mine"


def test_no_token_is_sent_or_written(head: Head, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    head.token = "very-secret"
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "very-secret")
    head.on_submit = lambda body: {"status": "SUCCEEDED"}
    assert launch(head, "--detach").exit_code == 0
    assert "very-secret" not in json.dumps(head.submitted)
    for path in (tmp_path / "s").rglob("*"):
        assert not path.is_file() or b"very-secret" not in path.read_bytes()


def test_modules_of_ones_own_travel(head: Head, tmp_path: Path) -> None:
    (tmp_path / "travel_envs.py").write_text(
        "from gymnasium.envs.classic_control import CartPoleEnv\nclass Mine(CartPoleEnv): pass\n"
    )
    head.on_submit = lambda body: {"status": "SUCCEEDED"}
    words = ("--detach", "--set", "env=travel_envs:Mine", "--set", "engine=rllib", "--allow-module", "travel_envs")
    done = launch(head, *words)
    assert done.exit_code == 0, done.output
    (name,) = head.packages
    assert head.submitted[0]["runtime_env"]["working_dir"] == f"gcs://{name}"


@pytest.mark.parametrize(
    ("becomes", "code", "said"),
    [
        (failed(f"exit code 5, last logs:\nerror: {NO_STORAGE}\nMount it.\n", 5), 5, f"{NO_STORAGE}\nMount it."),
        (
            failed("exit code 4, last logs:\nerror: No sweep 'x' in y.\nList.\n", 4),
            5,
            "the same on this machine and on",
        ),
        (failed("exit code 127, last logs:\nsh: tune-jobs: not found\n", 127), 5, "on the cluster's head"),
        (failed("runtime_env setup failed: no such package", None), 5, "runtime_env setup failed: no such package"),
        (failed("exit code 2, last logs:\nerror: Bad point.\n", 2), 2, "Bad point."),
    ],
)
def test_a_job_that_fails_at_once_leaves_nothing(
    head: Head, tmp_path: Path, becomes: dict[str, Any], code: int, said: str
) -> None:
    head.on_submit = lambda body: becomes
    done = launch(head, "--detach")
    assert (done.exit_code, said in done.stderr) == (code, True), done.stderr
    assert list((tmp_path / "s").iterdir()) == []


def test_a_new_sweep_whose_job_fails_is_to_be_launched_again(head: Head, tmp_path: Path) -> None:
    head.on_submit = lambda body: failed("runtime_env setup failed: no such package", None)
    done = launch(head, "--detach")
    assert (done.exit_code, "Nothing was kept; launch it again." in done.stderr) == (5, True), done.stderr
    assert "resume" not in done.stderr
    assert list((tmp_path / "s").iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [("resume",), ("extend", "--num-samples", "2"), ("replicate", "--top", "2"), ("inject", "lr=0.003")],
)
def test_a_sweep_that_was_there_before_its_job_stays_if_that_fails(
    head: Head, tmp_path: Path, words: tuple[str, ...]
) -> None:
    created = verbs.create("mine.yaml", name="mine", storage="s")
    head.on_submit = lambda body: failed("runtime_env setup failed: no such package", None)
    verb, *options = words
    done = run(verb, "mine", *options, "--storage", "s", "--address", head.address, "--detach")
    assert (done.exit_code, "no such package" in done.stderr) == (5, True), done.stderr
    assert SweepStore(created.folder).read_record().state == "created"
    hint = done.stderr.partition("Continue with `tune-jobs resume ")[2]
    assert hint.endswith(f"mine --address {head.address} --detach`.\n")


def test_a_refused_job_leaves_nothing(head: Head, tmp_path: Path) -> None:
    def refuse(body: dict[str, Any]) -> dict[str, Any]:
        raise ValueError("runtime_env is bad")

    head.on_submit = refuse
    done = launch(head, "--detach")
    assert done.exit_code == 5
    assert "ValueError: runtime_env is bad (status 500)" in done.stderr
    assert list((tmp_path / "s").iterdir()) == []


def test_a_bad_sweep_file_is_told_before_anything_is_sent(head: Head) -> None:
    assert launch(head, "--detach", "--set", "algorithm=sarsa").exit_code == 2
    assert head.submitted == []
    assert run("launch", "mine.yaml", "--detach").exit_code == 2
    assert launch(head, "--dry-run").exit_code == 2


def test_a_job_that_waits_is_shown_stopped_and_not_asked_for_twice(
    head: Head, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(detached.wait_until_begun, "__kwdefaults__", {"timeout_s": 0.1})
    head.on_submit = lambda body: {"status": "PENDING"}
    done = launch(head, "--detach")
    assert "has not begun yet" in done.stdout
    job = head.submitted[0]["submission_id"]
    assert f"{job} at {head.address}: pending" in run("status", "mine", "--storage", "s").stdout
    again = run("resume", "mine", "--storage", "s", "--address", head.address, "--detach")
    assert (again.exit_code, "is about to run sweep mine" in again.stderr) == (5, True)
    assert run("stop", "mine", "--storage", "s", "--json").exit_code == 0
    assert head.stopped == [job]


def test_the_verbs_are_jobs_with_their_options(head: Head, tmp_path: Path) -> None:
    make_sweep_folder(tmp_path / "s" / "mine")
    head.on_submit = lambda body: {"status": "SUCCEEDED"}
    at = ("--storage", "s", "--address", head.address, "--detach", "--no-finish")
    for words in (
        ("resume", "mine", "--retry-failed"), ("extend", "mine", "--num-samples", "2"),
        ("replicate", "mine", "--top", "3", "--seeds", "2", "--wait-for-nodes", "600.0"),
        ("inject", "mine", "lr=0.003"),
    ):  # fmt: skip
        assert run(*words, *at).exit_code == 0
        sent = shlex.split(head.submitted[-1]["entrypoint"])
        assert sent == [
            "tune-jobs", words[0], str(tmp_path / "s" / "mine"), *words[2:], "--address", "auto", "--no-finish"
        ]  # fmt: skip


def test_a_driver_notes_its_job_and_refuses_that_of_another_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, job = make_sweep_folder(tmp_path / "s" / "mine"), JobRecord(id="mine-1", address="http://head:8265")
    told = environment_of(job)["TUNE_JOBS_JOB"]
    monkeypatch.setenv("TUNE_JOBS_JOB", told)
    note_own_job(store)
    assert store.read_record().job == job
    monkeypatch.setenv("TUNE_JOBS_JOB", json.dumps({**json.loads(told), "version": "0.0.1"}))
    with pytest.raises(CannotRunError, match=r"this sweep was sent by 0\.0\.1"):
        note_own_job(store)
    # A sweep that is driven by no job any more names none.
    monkeypatch.delenv("TUNE_JOBS_JOB")
    note_own_job(store)
    assert store.read_record().job is None


def test_attach_shows_a_sweep_of_another_process_to_its_end(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    store = make_sweep_folder(tmp_path / "s" / "mine")
    with driven(store.folder, "completed"):
        done = run("attach", "mine", "--storage", "s")
    assert done.exit_code == 0, done.stderr
    assert "4 trials: 4 completed" in done.stdout
    assert "100 %, 2,400 env steps; 4 completed" in capfd.readouterr().err
    with driven(store.folder, "interrupted"):
        done = run("attach", "mine", "--storage", "s", "--json")
    assert (done.exit_code, json.loads(done.stdout)["exit_code"]) == (130, 130)


def test_attach_tells_of_a_job_that_waits_for_nodes(tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "s" / "mine")
    look = _Look(store)
    look.update()
    job = JobRecord(id="mine-1", address="http://127.0.0.1:9")
    with store.lock():
        store.write_record(store.read_record().model_copy(update={"job": job, "state": "created"}))
        look.update()
        assert look.monitor.phase == "its job joins the cluster"
        store.write_record(store.read_record().model_copy(update={"state": "running"}))
        look.update()
        assert look.monitor.phase == "starting the trials"


def test_attach_tells_of_a_driver_that_died_and_of_a_job_that_failed(head: Head, tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "s" / "mine")
    with driven(store.folder, "running"):
        done = run("attach", "mine", "--storage", "s")
    assert (done.exit_code, "has ended without finishing it" in done.stderr) == (5, True)
    job = JobRecord(id="mine-1", address=head.address)
    store.write_record(store.read_record().model_copy(update={"job": job}))
    head.jobs["mine-1"] = failed(f"exit code 5, last logs:\nerror: {NO_STORAGE}\nMount it.\n", 5)
    done = run("attach", "mine", "--storage", "s")
    assert (done.exit_code, NO_STORAGE in done.stderr) == (5, True)
    assert f"mine-1 at {head.address}: failed" in run("status", "mine", "--storage", "s").stdout


def test_status_of_a_sweep_whose_cluster_is_gone_is_told(head: Head, tmp_path: Path) -> None:
    store = make_sweep_folder(tmp_path / "s" / "mine")
    job = JobRecord(id="mine-1", address="http://127.0.0.1:9")
    store.write_record(store.read_record().model_copy(update={"job": job}))
    done = run("status", "mine", "--storage", "s", "--json")
    assert done.exit_code == 0
    assert json.loads(done.stdout)["job"]["state"].startswith("not known")


@pytest.fixture
def original(head: Head, tmp_path: Path) -> SweepStore:
    """A sweep whose job has not begun with it yet."""
    store = make_sweep_folder(tmp_path / "s" / "mine")
    job = JobRecord(id="mine-12ab34cd", address=head.address, place=store.place)
    store.write_record(store.read_record().model_copy(update={"job": job}))
    head.jobs[job.id] = {"status": "PENDING"}
    return store


# A record of before says nothing but the name.
@pytest.mark.parametrize(("copy", "is_of_before"), [("s/copy", False), ("other/mine", False), ("s/copy", True)])
def test_a_copied_sweep_is_not_run_by_the_originals_job(
    head: Head, original: SweepStore, tmp_path: Path, copy: str, is_of_before: bool
) -> None:
    if is_of_before:
        without_place(original)
    copied = SweepStore(Path(shutil.copytree(original.folder, tmp_path / copy)))
    with original.lock():
        assert not verbs.stop(copied.folder)
        assert not _Look(copied).goes_on()
        assert head.stopped == []
        told = run("status", copied.place)
        assert (told.exit_code, "mine-12ab34cd" in told.stdout) == (0, False)
        head.on_submit = lambda body: {"status": "SUCCEEDED"}
        done = run("extend", copied.place, "--num-samples", "1", "--address", head.address, "--detach")
        assert done.exit_code == 0, done.output
    assert shlex.split(head.submitted[0]["entrypoint"])[:3] == ["tune-jobs", "extend", copied.place]
    told_place = json.loads(head.submitted[0]["runtime_env"]["env_vars"]["TUNE_JOBS_JOB"])["place"]
    assert told_place == copied.place


@pytest.mark.parametrize("is_of_before", [False, True])
def test_a_sweeps_own_job_is_found_by_any_path_to_it(
    head: Head, original: SweepStore, tmp_path: Path, is_of_before: bool
) -> None:
    if is_of_before:
        without_place(original)
    (tmp_path / "linked").symlink_to(tmp_path / "s")
    for number, place in enumerate((Path("s/mine"), tmp_path / "linked" / "mine", original.folder), start=1):
        assert "mine-12ab34cd" in run("status", str(place)).stdout
        assert verbs.stop(place)
        assert head.stopped == ["mine-12ab34cd"] * number
    again = run("extend", "s/mine", "--num-samples", "1", "--address", head.address, "--detach")
    assert (again.exit_code, "is about to run sweep mine" in again.stderr) == (5, True)


def test_the_job_of_a_folder_that_has_another_path_here_is_its_own(
    head: Head, original: SweepStore, tmp_path: Path
) -> None:
    """It was moved, or the one who stops it reaches the same disk by another path than the one who launched it."""
    moved = Path(shutil.move(original.folder, tmp_path / "elsewhere" / "mine"))
    assert verbs.stop(moved)
    assert head.stopped == ["mine-12ab34cd"]
    assert not verbs.stop(shutil.move(moved, tmp_path / "renamed"))
    assert head.stopped == ["mine-12ab34cd"]


def test_a_driver_notes_of_which_sweep_its_job_is(
    original: SweepStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "linked").symlink_to(tmp_path / "s")
    job = JobRecord(id="mine-34cd56ef", address="http://head:8265", place=str(tmp_path / "linked" / "mine"))
    monkeypatch.setenv("TUNE_JOBS_JOB", environment_of(job)["TUNE_JOBS_JOB"])
    note_own_job(original)
    # As `wait_until_begun` expects it.
    assert original.read_record().job == job
    assert job_of(original.read_record(), original.place) == job


def without_place(store: SweepStore) -> None:
    """Leave out of a record what former versions did not write."""
    data = json.loads(store.record_path.read_text())
    data["job"].pop("place", None)
    store.record_path.write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("one", "other", "is_same"),
    [
        ("s3://b/s/mine", "s3://b/s/mine", True),
        ("s3://b/s/mine?endpoint=http://h:9000", "s3://b/s/mine", True),
        ("s3://b/s/mine?endpoint=http://h:9000&region=r", "s3://b/s/mine?region=r&endpoint=http://h:9000", True),
        ("s3://b/s/mine?endpoint=http://h:9000", "s3://b/s/mine?endpoint=http://h:9001", False),
        ("s3://b/s/mine?endpoint=http://h:9000&region=q", "s3://b/s/mine?endpoint=http://h:9000&region=r", True),
        ("s3://b/s/mine?endpoint=http://h:9000", "s3://b/s/mine?endpoint=http://h:9000/", True),
        ("s3://b/s/mine", "s3://b/s/copy", False),
        ("s3://b/s/mine", "gs://b/s/mine", False),
        ("s3://b/s/mine", "/s/mine", False),
        ("s3://", "s3://b/s/mine", False),
        ("/not/here/mine", "/", False),
        ("\0", "/", False),
        ("/", "/.", True),
    ],
)
def test_places_are_the_same_if_they_lead_to_the_same_files(one: str, other: str, is_same: bool) -> None:
    assert (is_same_place(one, other), is_same_place(other, one)) == (is_same, is_same)


def test_a_job_of_before_is_known_by_the_name_in_a_bucket_too(original: SweepStore) -> None:
    record = original.read_record().model_copy(update={"job": JobRecord(id="mine-12ab34cd", address="http://head")})
    assert job_of(record, "s3://b/s/mine") == record.job
    assert job_of(record, "s3://b/s/copy") is None

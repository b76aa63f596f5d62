"""The commands that are told to go on with a sweep do that, wherever it is, and with no other one."""

import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
from fake_sweeps import FakeSweeps, RunCommand, run, sweeps  # noqa: F401 (fixtures)
from sweep_folders import make_sweep_folder

from analysis.records import JobRecord, ReplicationRecord
from tune_jobs.cli.output import show_result
from tune_jobs.store.opening import resume_command
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import verbs
from tune_jobs.sweeps.outcome import SweepResult

# ruff: noqa: F811 - fixtures are named as arguments

JOB = JobRecord(id="mine-1", address="http://head:8265")
RAN = pytest.mark.parametrize(
    ("ran", "options"),
    [
        ({}, ""),
        ({"address": "ray://head:10001"}, " --address ray://head:10001"),
        ({"job": JOB}, " --address http://head:8265 --detach"),
    ],
)


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SweepStore:
    """A sweep that was interrupted, in no storage that commands look in."""
    monkeypatch.setattr("tune_jobs.sweeps.detached.job_now", lambda *_: None)
    made = make_sweep_folder(tmp_path / "my data" / "mine", iterations=1)
    made.write_record(made.read_record().model_copy(update={"state": "interrupted"}))
    return made


def change(store: SweepStore, **changes: Any) -> None:
    store.write_record(store.read_record().model_copy(update=changes))


@RAN
@pytest.mark.parametrize("storage", [None, "my data"])
def test_a_status_names_the_sweep_by_its_place_and_where_it_ran(
    run: RunCommand, store: SweepStore, ran: dict[str, Any], options: str, storage: str | None
) -> None:
    change(store, **ran)
    told = run("status", store.folder) if storage is None else run("status", "mine", "--storage", storage)
    command = f"tune-jobs resume {shlex.quote(store.place)}{options}"
    assert f"nothing runs; `{command}` continues it" in told.stdout
    assert command == resume_command(store, store.read_record())
    # As in a notebook.
    assert command in verbs.status(store.folder).facts()["time left"]


@RAN
def test_what_was_interrupted_does_so_too(
    capsys: pytest.CaptureFixture[str], store: SweepStore, ran: dict[str, Any], options: str
) -> None:
    change(store, **ran)
    result = SweepResult(store.place, store.read_record(), store.read_trials(), interrupted=True)
    show_result(result, as_json=False)
    told = f"Continue with: tune-jobs resume {shlex.quote(store.place)}{options}"
    assert capsys.readouterr().err.strip().endswith(told)


def test_in_the_default_storage_the_name_is_enough(
    run: RunCommand, store: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TUNE_JOBS_STORAGE", "my data")
    assert "`tune-jobs resume mine` continues it" in run("status", store.folder).stdout


@pytest.mark.parametrize(("state", "words"), [("created", "Run it with"), ("running", "continue with")])
def test_attach_does_so_too(run: RunCommand, store: SweepStore, state: str, words: str) -> None:
    change(store, state=state, address="ray://head:10001")
    told = run("attach", store.folder)
    assert told.exit_code == 5
    command = f"tune-jobs resume {shlex.quote(store.place)} --address ray://head:10001"
    assert f"{words} `{command}`" in told.stderr


def test_stop_names_the_storage(run: RunCommand, sweeps: FakeSweeps) -> None:
    assert "`tune-jobs resume mine --storage 'my data'` continues" in run("stop", "mine", "--storage", "my data").stdout
    assert "`tune-jobs resume mine` continues" in run("stop", "mine").stdout


@RAN
def test_a_stop_names_where_it_ran(run: RunCommand, store: SweepStore, ran: dict[str, Any], options: str) -> None:
    change(store, state="running", **ran)
    with store.lock():
        told = run("stop", "mine", "--storage", "my data")
    assert told.exit_code == 0, told.output
    assert f"`tune-jobs resume {shlex.quote(store.place)}{options}` continues it" in told.stdout


def test_a_stop_is_told_of_a_sweep_whose_record_is_damaged(run: RunCommand, store: SweepStore) -> None:
    (store.folder / "sweep.json").write_text("{")
    with store.lock():
        told = run("stop", "mine", "--storage", "my data")
    assert told.exit_code == 0, told.output
    assert "`tune-jobs resume mine --storage 'my data'` continues it" in told.stdout


def test_a_stop_by_a_service_names_that(run: RunCommand, store: SweepStore, monkeypatch: pytest.MonkeyPatch) -> None:
    change(store, job=JOB)
    monkeypatch.setenv("TUNE_JOBS_STORAGE", "my data")
    monkeypatch.setattr("tune_jobs.cli.remote.RemoteVerbs.stop", lambda *_, **__: True)
    told = run("--server", "http://host:8470", "stop", "mine")
    assert "`tune-jobs --server http://host:8470 resume mine` continues it" in told.stdout


def test_a_copied_sweep_is_called_after_its_folder(run: RunCommand, store: SweepStore) -> None:
    copy = shutil.copytree(store.folder, store.folder.parent / "backup")
    rows = run("list", "--storage", copy.parent).stdout.splitlines()
    assert [row.split()[0] for row in rows if "interrupted" in row] == ["backup", "mine"]
    told = run("status", "backup", "--storage", copy.parent).stdout
    assert told.splitlines()[0].split() == ["sweep", "backup"]
    assert f"resume {shlex.quote(str(copy))}` continues it" in told
    assert verbs.status(copy).sweep.name == "backup"
    assert "place" not in run("status", copy, "--json").stdout


def test_a_sweep_that_was_killed_between_its_trials_and_more_seeds_for_its_leaders_is_told_how_they_get_them(
    run: RunCommand, tmp_path: Path
) -> None:
    store = make_sweep_folder(tmp_path / "raced", num_samples=4, seeds_per_point=1, confirm={"max_share": 2.0})
    command = f"tune-jobs resume {shlex.quote(store.place)}"
    told = f"nothing runs; `{command}` does what follows the trials: more seeds for its leading settings (confirm)"
    assert told in run("status", store.folder).stdout
    assert "lacks_seeds" not in run("status", store.folder, "--json").stdout + repr(verbs.status(store.folder))
    shown = run("attach", store.folder)
    assert shown.exit_code == 0
    left_out = "its leading settings got no more seeds (confirm), as nothing followed the trials"
    # A terminal's width breaks lines.
    words = " ".join(shown.stdout.split())
    assert f"no best policy: none was chosen, and {left_out}: `{command}` does both" in words
    assert "tune-jobs best" not in words
    with store.lock():
        assert told not in run("status", store.folder).stdout
    change(store, replications=(ReplicationRecord(num_points=4, points=(3, 2), by="confirm"),))
    assert told not in run("status", store.folder).stdout


def test_to_tell_so_no_environment_is_made(run: RunCommand, tmp_path: Path) -> None:
    """One of a module of one's own can't be, where nobody allowed it to be imported."""
    store = make_sweep_folder(tmp_path / "raced", num_samples=4, seeds_per_point=1, confirm={"max_share": 2.0})
    objective = {"type": "steps_to_threshold"}
    change(store, spec={**store.read_record().spec, "env": {"id": "own_envs:Mine-v0"}, "objective": objective})
    words = " ".join(run("attach", store.folder).stdout.split())
    assert "its leading settings got no more seeds (confirm), as nothing followed the trials" in words


@pytest.mark.parametrize("spec", [{}, {"num_samples": 1, "seeds_per_point": 4, "confirm": {"max_share": 2.0}}])
def test_one_whose_leaders_get_none_has_its_best_policy_chosen_alone(
    run: RunCommand, tmp_path: Path, spec: dict[str, Any]
) -> None:
    store = make_sweep_folder(tmp_path / "mine", **spec)
    assert "nothing runs" not in run("status", store.folder).stdout
    words = " ".join(run("attach", store.folder).stdout.split())
    assert f"none was chosen. `tune-jobs best {store.place}` does it" in words

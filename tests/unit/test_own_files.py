"""An upgrade while a process runs: what is loaded need not fit what is imported after it, which is no bug."""

from __future__ import annotations

import contextlib
import os
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner
from fake_sweeps import FakeSweeps, RunCommand
from store_parts import make_trial
from sweep_folders import MACHINE, make_sweep_folder

from tune_jobs.cli.commands import cli
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.process import own_files
from tune_jobs.ray_tune import run_trials
from tune_jobs.ray_tune.cluster import Connection
from tune_jobs.service import driver
from tune_jobs.service.job_files import Ended
from tune_jobs.spec.file import stored_spec
from tune_jobs.sweeps import drive, importing

MISSING = ImportError("cannot import name 'new' from 'policies.errors'")
CHANGED = "Files of tune-jobs were changed while this ran, as by an upgrade. "


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file of an installation that was there before this process."""
    file = tmp_path / "site" / "analysis" / "page" / "report.html"
    file.parent.mkdir(parents=True)
    file.touch()
    monkeypatch.setattr(own_files, "_ROOT", tmp_path / "site")
    monkeypatch.setattr(own_files, "_BEGAN_AT", file.stat().st_ctime)
    # By which the system's times of files may lag.
    time.sleep(0.02)
    return file


@pytest.fixture
def tracebacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are kept in the test's folder."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


def test_what_was_there_before_was_not_changed(installed: Path) -> None:
    assert not own_files.were_changed()
    # Who imports a module writes this.
    (installed.parent / "__pycache__").mkdir()
    (installed.parent / "__pycache__" / "head.pyc").touch()
    (installed.parents[2] / "elsewhere.py").touch()
    assert not own_files.were_changed()


@pytest.mark.parametrize("name", ["tune_jobs/new.py", "policies/envs/new.py", "analysis/page/report.html"])
def test_a_file_that_came_later_was_changed_whatever_age_its_package_gives_it(installed: Path, name: str) -> None:
    file = installed.parents[2] / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("later")
    os.utime(file, (0, 0))
    assert own_files.were_changed()


def test_a_file_of_the_future_is_not_found_changed_by_each_process(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (installed.parent / "later.py").touch()
    monkeypatch.setattr(own_files, "time", SimpleNamespace(time=lambda: own_files._BEGAN_AT + 0.001))
    assert not own_files.were_changed()


def test_a_module_that_is_loaded_and_gone_was_changed(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = types.ModuleType("analysis.page.gone")
    monkeypatch.setitem(sys.modules, "analysis.page.gone", module)
    # One of a user's own package of that name.
    module.__file__ = str(installed.parents[3] / "project" / "analysis" / "gone.py")
    assert not own_files.were_changed()
    module.__file__ = str(installed.parent / "gone.py")
    assert own_files.were_changed()


@pytest.mark.parametrize(
    ("verb", "go_on"),
    [
        ("resume", "What is done is kept; `tune-jobs resume SWEEP` continues it."),
        ("best", "Run the command again."),
        ("reproduce", "Run the command again."),
    ],
)
@pytest.mark.usefixtures("tracebacks")
def test_the_command_says_so_and_how_to_go_on(
    run: RunCommand, sweeps: FakeSweeps, installed: Path, verb: str, go_on: str
) -> None:
    words = (verb, "mine")
    sweeps.answers[verb] = MISSING
    said = run(*words).stderr
    assert "This is a bug in tune-jobs. The traceback is in " in said
    installed.write_text("later")
    result = run(*words)
    assert result.exit_code == 1
    assert f"error: Unexpected ImportError: {MISSING}\n{CHANGED}{go_on} The traceback is in " in result.stderr
    assert "This is a bug" not in result.stderr
    said = CliRunner().invoke(cli, ["--debug", *words]).stderr
    assert said.endswith(f"error: Unexpected ImportError: {MISSING}\n{CHANGED}{go_on}\n")


def test_a_service_goes_on_with_the_job(
    installed: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def done(_: object) -> None:
        raise MISSING

    monkeypatch.setattr(driver, "_done", done)
    assert driver._ended({"attempt": 1}).outcome == "failed"
    installed.write_text("later")
    assert driver._ended({"attempt": 1}) == Ended(attempt=1, outcome="interrupted")
    assert caplog.messages == ["Files of tune-jobs were changed while this ran, as by an upgrade: it goes on later."]


def test_what_follows_the_trials_is_imported_when_one_has_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    imported: list[str] = []
    told: list[list[str]] = []

    def run(_: object, listener: Callable[[Any], None]) -> None:
        began = make_trial(1, status="running", num_iterations=6, num_env_steps=first.num_env_steps)
        for record in (began, *[began.model_copy(update={"num_env_steps": 10**6 + n}) for n in range(2)]):
            listener(record)
            told.append(list(imported))

    store = make_sweep_folder(tmp_path / "mine")
    first = store.trial("t0001").read_record().model_copy(update={"status": "pending"})
    store.trial("t0001").write_record(first)
    connection = Connection("here", is_client=False, machine=MACHINE)
    monkeypatch.setattr(drive, "connected", lambda *_, **__: contextlib.nullcontext(connection))
    monkeypatch.setattr(run_trials, "run_trials", run)
    monkeypatch.setattr(importing, "importlib", SimpleNamespace(import_module=imported.append))
    importing._import_what_follows.cache_clear()
    plan = make_plan(stored_spec(store.read_record()), MACHINE)
    with store.lock(), drive.Shared() as shared:
        drive.run_trials_of(store, plan, shared, address=None, machine=MACHINE, progress="none")
        assert shared.monitor is not None
        assert shared.monitor.records["t0001"].num_env_steps == 10**6 + 1
    importing._import_what_follows.cache_clear()
    assert told[0] == []
    assert set(told[1]) >= {"tune_jobs.sweeps.conclude", "analysis.report"}
    assert told[2] == told[1]

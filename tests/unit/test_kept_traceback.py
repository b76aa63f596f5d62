"""The traceback of an unexpected error, where it can hardly be kept."""

import tempfile
from pathlib import Path

import pytest
from click.testing import CliRunner
from fake_sweeps import FakeSweeps, RunCommand

from tune_jobs.cli.commands import cli


def test_without_a_temporary_file_the_traceback_is_printed(sweeps: FakeSweeps, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: ["/no/such/folder"])
    sweeps.answers["best"] = ZeroDivisionError("a bug")
    result = CliRunner().invoke(cli, ["best", "mine"])
    assert result.exit_code == 1
    traceback, _, said = result.stderr.partition("error: Unexpected ZeroDivisionError: a bug")
    assert traceback.startswith("Traceback")
    # That no file can be written is no part of it.
    assert traceback.rstrip().endswith("ZeroDivisionError: a bug")
    assert "The traceback is above, as no temporary file can be written: " in said
    assert "/no/such/folder" in said


def test_an_error_that_is_no_text_has_a_traceback_too(
    run: RunCommand, sweeps: FakeSweeps, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    sweeps.answers["best"] = ZeroDivisionError("a \udcff bug")
    assert run("best", "mine").exit_code == 1
    (kept,) = tmp_path.glob("tune-jobs-error-*.txt")
    assert "ZeroDivisionError: a \\udcff bug" in kept.read_text()

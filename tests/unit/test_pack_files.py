"""Whom a pack is to train, and the end of what it printed."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from policies.errors import CheckpointError
from tune_jobs.store.pack_files import Assignment, PackFiles


def test_an_assignment_is_read_as_it_was_written(tmp_path: Path) -> None:
    files = PackFiles(tmp_path, "p03")
    assignment = Assignment(("t0007", "t0002"), {"t0002": 2})
    files.write(assignment)
    assert PackFiles(tmp_path, "p03").read() == assignment
    files.write(Assignment())
    assert files.read() == Assignment((), {})


@pytest.mark.parametrize("content", [None, "{", "[]", '{"trial_ids": ["t0000"]}'])
def test_an_assignment_that_cannot_be_read_is_an_error_with_its_path(tmp_path: Path, content: str | None) -> None:
    files = PackFiles(tmp_path, "p00")
    if content is not None:
        files.write(Assignment())
        files.assignment_path.write_text(content)
    with pytest.raises(CheckpointError, match=r"p00\.json"):
        files.read()


def log(files: PackFiles, capsys: pytest.CaptureFixture[str], *parts: Sequence[str]) -> None:
    """Processes one after the other: each begins the log, then prints its lines."""
    files.log_path.parent.mkdir(parents=True, exist_ok=True)
    with files.log_path.open("a") as file:
        for lines in parts:
            files.begin_log()
            file.write(capsys.readouterr().out + "".join(f"{line}\n" for line in lines))


def test_the_end_of_a_log_is_of_the_last_process(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = PackFiles(tmp_path, "p00")
    assert files.log_tail() == ""
    threads = [f"  File thread-{index}" for index in range(30)]
    log(files, capsys, ["Timeout (0:00:10)!", *threads], ["killed"])
    begun, last = files.log_tail().splitlines()
    assert begun.startswith("-- pack p00, process ")
    assert last == "killed"

"""The files that the guard shares with its child."""

import os
import tempfile
from pathlib import Path
from typing import IO

import pytest

from policies.envs.calls import PAGE_BYTES
from policies.errors import CannotRunError
from policies.guard.guard import EnvGuard
from policies.guard.shared_files import shared_files

FULL = Path("/dev/full")


def test_the_page_has_its_place_on_the_disk_before_it_is_touched() -> None:
    """Else a disk that is full by then ends the process, the service's too."""
    page, dump = shared_files()
    with page, dump:
        assert os.lseek(page.fileno(), 0, os.SEEK_HOLE) == PAGE_BYTES


@pytest.mark.skipif(not FULL.exists(), reason="Linux has this device")
def test_a_full_disk_is_told_and_what_was_opened_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[IO[bytes]] = []

    def on_a_full_disk() -> IO[bytes]:
        opened.append(FULL.open("w+b"))
        return opened[-1]

    monkeypatch.setattr("tempfile.tempdir", "/small")
    monkeypatch.setattr(tempfile, "TemporaryFile", on_a_full_disk)
    with EnvGuard() as guard, pytest.raises(CannotRunError, match="in /small: No space left on device") as caught:
        guard.start()
    assert "TMPDIR" in caught.value.hint
    assert opened
    assert all(file.closed for file in opened)


def test_without_a_folder_for_temporary_files_those_that_were_tried_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: ["/no/such/folder"])
    with EnvGuard() as guard, pytest.raises(CannotRunError, match=r"none can be written: .*/no/such/folder"):
        guard.start()


def test_a_file_that_cannot_be_made_closes_the_one_before(monkeypatch: pytest.MonkeyPatch) -> None:
    files = [tempfile.TemporaryFile()]  # noqa: SIM115 (closed by what is tested)
    left = files.copy()

    def make() -> IO[bytes]:
        if not left:
            raise OSError(28, "No space left on device", "/small")
        return left.pop()

    monkeypatch.setattr(tempfile, "TemporaryFile", make)
    with pytest.raises(CannotRunError):
        shared_files()
    assert files[0].closed

"""Parts of a storage folder that this user may not look at: said in our words, and the others are shown."""

import os
from collections.abc import Callable
from os import stat_result
from pathlib import Path
from typing import Any, cast

import pytest
from broken_storage import pathlib_of  # noqa: F401 (a fixture)
from sweep_folders import make_sweep_folder

from policies.errors import CheckpointError
from tune_jobs.sweeps import verbs as sweeps


@pytest.fixture
def closed(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Close a folder, to root as well: nothing below it can be looked at, nor what lies in it."""
    folders: list[Any] = []

    def closing(name: str) -> Callable[..., int | stat_result | list[str]]:
        real = getattr(os, name)

        def call(path: str | Path, *arguments: int, **options: bool) -> int | stat_result | list[str]:
            text = os.fspath(path) if isinstance(path, (str, os.PathLike)) else ""
            listed = f"{text}/" if name in ("listdir", "scandir") else text
            if any(listed.startswith(f"{folder}/") for folder in folders):
                raise PermissionError(13, "Permission denied", text)
            return cast("int | stat_result | list[str]", real(path, *arguments, **options))

        return call

    for name in ("stat", "lstat", "open", "listdir", "scandir"):
        monkeypatch.setattr(os, name, closing(name))
    return folders.append


@pytest.fixture
def storage(tmp_path: Path) -> Path:
    for name in ("mine", "other"):
        make_sweep_folder(tmp_path / name, iterations=1)
    return tmp_path


def test_a_sweep_that_may_not_be_looked_at_does_not_hide_the_others(
    storage: Path, closed: Callable[..., Any], caplog: pytest.LogCaptureFixture
) -> None:
    closed(storage / "other")
    assert [status.sweep.name for status in sweeps.list_sweeps(storage)] == ["mine"]
    assert f"{storage}/other/sweep.json cannot be read: Permission denied" in caplog.text
    assert sweeps.status("mine", storage=storage).counts == {"completed": 4}
    with pytest.raises(CheckpointError, match=r"other/sweep.json cannot be read: Permission denied"):
        sweeps.status("other", storage=storage)


def test_a_trial_that_may_not_be_looked_at_does_not_hide_the_others(
    storage: Path, closed: Callable[..., Any], caplog: pytest.LogCaptureFixture
) -> None:
    closed(storage / "mine" / "trials" / "t0001")
    assert [trial.trial_id for trial in sweeps.trials("mine", storage=storage)] == ["t0000", "t0002", "t0003"]
    assert f"{storage}/mine/trials/t0001/trial.json cannot be read: Permission denied" in caplog.text
    assert sweeps.status("mine", storage=storage).counts == {"completed": 3}


@pytest.mark.parametrize("part", ["trials", "trials/t0001/checkpoints"])
def test_a_part_of_a_sweep_that_may_not_be_looked_at_is_named(
    storage: Path, closed: Callable[..., Any], part: str
) -> None:
    closed(storage / "mine" / Path(part))
    with pytest.raises(CheckpointError, match=f"mine/{part}.* cannot be read: Permission denied"):
        sweeps.trials("mine", storage=storage)


def test_a_storage_folder_that_may_not_be_looked_into_is_named(storage: Path, closed: Callable[..., Any]) -> None:
    closed(storage)
    with pytest.raises(CheckpointError, match=f"{storage} cannot be read: Permission denied"):
        sweeps.list_sweeps(storage)


@pytest.mark.usefixtures("pathlib_of")
def test_what_may_not_be_looked_at_is_not_left_out_in_silence(
    storage: Path, closed: Callable[..., Any], caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever Python's pathlib says of it: 3.14's says that it is not there."""
    closed(storage / "other")
    closed(storage / "mine" / "trials" / "t0001")
    assert [status.sweep.name for status in sweeps.list_sweeps(storage)] == ["mine"]
    assert f"{storage}/other/sweep.json cannot be read: Permission denied" in caplog.text
    with pytest.raises(CheckpointError, match=r"other/sweep.json cannot be read: Permission denied"):
        sweeps.status("other", storage=storage)
    assert sweeps.status("mine", storage=storage).counts == {"completed": 3}
    assert f"{storage}/mine/trials/t0001/trial.json cannot be read: Permission denied" in caplog.text

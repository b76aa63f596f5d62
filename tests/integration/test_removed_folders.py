"""Environments that go to a folder of their own and remove it: the process goes back to one that there is."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_packed_envs import make, own_modules

from policies.envs import working_folder
from policies.envs.faults import close_env
from policies.envs.make import make_env
from policies.errors import EnvError
from policies.guard import guarded
from policies.guard.guard import guarding

__all__ = ["make", "own_modules"]


@pytest.fixture(autouse=True)
def _stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(working_folder, "_BEGAN_IN", str(tmp_path))
    yield
    monkeypatch.chdir(tmp_path)


def test_the_guard_goes_on_with_them() -> None:
    with guarding():
        assert guarded.check_env("odd_envs:Travels", None).env_id == "odd_envs:Travels"
        guarded.check_seedable("odd_envs:Travels", None)
        assert guarded.measure_step("odd_envs:Travels", None).us is not None


def test_the_guard_goes_on_after_one_that_could_not_be_made() -> None:
    with guarding():
        with pytest.raises(EnvError, match="nothing to do here"):
            guarded.check_env("odd_envs:Travels", {"fails": True})
        guarded.check_seedable("odd_envs:Travels", None)


@pytest.mark.parametrize("kind", ["scalar", "processes"])
def test_so_do_packs(make: Any, kind: str) -> None:
    envs = make("odd_envs:Travels", kind, num_envs=2, members={"a": 1}, num_processes=2)
    envs.remove("a")
    envs.add("b", 2)
    assert envs.step(np.zeros(2, np.int64)).rewards.all()
    assert envs.errors == {}


def test_only_a_folder_that_is_removed_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "other").mkdir()
    env = make_env("odd_envs:Fragile")
    monkeypatch.chdir("other")
    close_env(env)
    assert Path.cwd() == tmp_path / "other"
    (tmp_path / "other").rmdir()
    close_env(env)
    assert Path.cwd() == tmp_path


def test_where_both_are_removed_it_is_left_to_who_needs_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("began", "other"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(working_folder, "_BEGAN_IN", str(tmp_path / "began"))
    env = make_env("odd_envs:Fragile")
    monkeypatch.chdir("other")
    for name in ("began", "other"):
        (tmp_path / name).rmdir()
    close_env(env)
    with pytest.raises(FileNotFoundError):
        Path.cwd()


def test_a_folder_that_cannot_be_told_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where the system keeps programs out of it."""

    def getcwd() -> str:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "getcwd", getcwd)
    assert working_folder._folder() is None

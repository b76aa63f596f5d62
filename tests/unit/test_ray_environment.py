"""What Ray finds in the environment, where a home folder is missing or can't be written."""

import os
from pathlib import Path

import pytest

from tune_jobs.process.home import name_a_home
from tune_jobs.ray_tune import environment as ray_environment
from tune_jobs.ray_tune.environment import provide_token

NAMES = ["RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"]


@pytest.fixture(autouse=True)
def no_token(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in NAMES:
        # As pytest puts back what was there.
        monkeypatch.setenv(name, "")


def token() -> str:
    return os.environ["RAY_AUTH_TOKEN"]


def test_a_home_that_cannot_be_written_needs_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("HOME", str(tmp_path / "file"))
    provide_token()
    first = token()
    assert len(first) == 64
    # The next sweep of this process has the same: Ray has read it.
    monkeypatch.setenv("RAY_AUTH_TOKEN", "")
    provide_token()
    assert token() == first


def test_a_user_without_a_home_needs_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def home() -> None:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(ray_environment.Path, "home", home)  # type: ignore[attr-defined]
    provide_token()
    assert token()


def test_elsewhere_it_is_rays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    provide_token()
    assert not token()


@pytest.mark.parametrize("name", NAMES)
def test_what_the_user_has_set_holds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("HOME", str(tmp_path / "file"))
    monkeypatch.setenv(name, "mine")
    provide_token()
    assert {key: os.environ[key] for key in NAMES} == {key: "mine" if key == name else "" for key in NAMES}


def test_a_user_that_no_file_names_can_import_what_ray_tune_needs_a_home_for(monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody(number: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {number}")

    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setattr("pwd.getpwuid", nobody)
    with pytest.raises(RuntimeError, match="home directory"):
        Path("~/ray_results").expanduser()
    name_a_home()
    assert not Path("~/ray_results").expanduser().parent.exists()
    monkeypatch.setenv("HOME", "/home/ann")
    name_a_home()
    assert os.environ["HOME"] == "/home/ann"

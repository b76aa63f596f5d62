"""What Ray finds in the environment: a home folder, which may be missing or unwritable, and one for its own files."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from ray._common.utils import get_default_ray_temp_dir
from ray._private.utils import validate_socket_filepath

from policies.errors import CannotRunError
from tune_jobs.process.home import name_a_home
from tune_jobs.ray_tune import environment as ray_environment
from tune_jobs.ray_tune.address import rays_folder
from tune_jobs.ray_tune.environment import provide_token
from tune_jobs.ray_tune.local_ray import start

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


def test_the_python_api_imports_what_ray_tune_needs_a_home_for_too() -> None:
    code = """if True:
        import os, pwd

        def nobody(number):
            raise KeyError(f"getpwuid(): uid not found: {number}")

        os.environ.pop("HOME", None)
        pwd.getpwuid = nobody
        import tune_jobs.sweeps.verbs
        import tune_jobs.ray_tune.run_trials
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("platform", ["linux", "darwin"])
@pytest.mark.parametrize("names", [(), ("TMPDIR",), ("RAY_TMPDIR",), ("TMPDIR", "RAY_TMPDIR")])
def test_rays_folder_is_where_ray_has_it(
    monkeypatch: pytest.MonkeyPatch, platform: str, names: tuple[str, ...]
) -> None:
    for name in ("TMPDIR", "RAY_TMPDIR"):
        monkeypatch.delenv(name, raising=False)
    for name in names:
        monkeypatch.setenv(name, f"/scratch/{name}")
    monkeypatch.setattr("sys.platform", platform)
    assert rays_folder() == Path(get_default_ray_temp_dir())


@pytest.mark.parametrize(
    ("folder", "hint"),
    [
        ("/scratch", "Look for the cause in Ray's logs in {}/session_latest/logs."),
        (f"/{'x' * 60}", "{} is too long a path for Ray's sockets: set RAY_TMPDIR to a short folder, such as /tmp."),
    ],
)
def test_a_ray_that_cannot_be_started_names_its_own_folder(
    monkeypatch: pytest.MonkeyPatch, folder: str, hint: str
) -> None:
    def init(**_: Any) -> None:
        session = "session_2026-11-30_05-31-00_123456_123456"
        validate_socket_filepath(str(Path(get_default_ray_temp_dir(), session, "sockets", "plasma_store")))
        raise RuntimeError("far enough")

    monkeypatch.setenv("RAY_TMPDIR", folder)
    monkeypatch.setattr("ray.init", init)
    with pytest.raises(CannotRunError) as caught:
        start(None)
    assert caught.value.hint == hint.format(f"{folder}/ray")

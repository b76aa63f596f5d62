"""What of a folder of a user's own travels to a cluster, and what never does."""

import io
import zipfile
from pathlib import Path

import pytest

from policies.errors import SpecError
from tune_jobs.sweeps import travel


def names(content: bytes) -> list[str]:
    return zipfile.ZipFile(io.BytesIO(content)).namelist()


def test_modules_travel_and_secrets_environments_and_sweeps_do_not(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    for path in (
        "my_envs.py", "package/__init__.py", "package/data.csv", ".env", ".git/config", "package/__pycache__/a.pyc",
        "virtual/pyvenv.cfg", "virtual/lib.py", "sweeps/one/sweep.json", "sweeps/one/trials/big", "two/sweep.json",
    ):  # fmt: skip
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text("x")
    (tmp_path / "secret").write_text("x")
    (folder / "outside").symlink_to(tmp_path / "secret")
    (folder / "inside").symlink_to("my_envs.py")
    content = travel.packed(folder)
    assert names(content) == ["inside", "my_envs.py", "package/__init__.py", "package/data.csv"]
    assert content == travel.packed(folder)


def test_a_folder_travels_only_if_a_module_lies_in_it(tmp_path: Path) -> None:
    (tmp_path / "my_envs.py").touch()
    assert travel.folder_to_send(["my_envs"], tmp_path) == tmp_path
    assert travel.folder_to_send(["gymnasium.envs"], tmp_path) is None
    assert travel.folder_to_send([], tmp_path) is None


def test_too_large_a_folder_is_refused_with_what_is_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(travel, "MAX_BYTES", 3 * 2**20)
    (tmp_path / "data").mkdir()
    for name in ("data/a", "data/b", "my_envs.py"):
        (tmp_path / name).write_bytes(bytes(2 * 2**20))
    with pytest.raises(SpecError, match=r"holds 6 MiB.*3 MiB.*data \(4 MiB\), my_envs.py \(2 MiB\)"):
        travel.packed(tmp_path)

"""What of a folder of a user's own travels to a cluster, and what never does."""

import io
import os
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


def test_a_module_that_is_a_link_into_the_folder_travels(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    for path in ("src/pkg/__init__.py", "src/pkg/sub/more.py"):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text("x")
    (folder / "pkg").symlink_to("src/pkg")
    assert travel.folder_to_send(["pkg"], folder) == folder
    own = ["src/pkg/__init__.py", "src/pkg/sub/more.py"]
    assert names(travel.packed(folder)) == ["pkg/__init__.py", "pkg/sub/more.py", *own]


def test_links_in_a_circle_are_followed_once(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    for name in ("a", "b"):
        (folder / name).mkdir(parents=True)
        (folder / name / "one.py").write_text("x")
    (folder / "a" / "up").symlink_to("..")
    (folder / "a" / "other").symlink_to("../b")
    (folder / "b" / "other").symlink_to("../a")
    (folder / "itself").symlink_to("itself")
    assert names(travel.packed(folder)) == ["a/one.py", "a/other/one.py", "b/one.py", "b/other/one.py"]


def test_a_link_to_what_stays_here_stays_too(tmp_path: Path) -> None:
    folder, elsewhere = tmp_path / "mine", tmp_path / "elsewhere"
    for path in (".env", ".hidden/pkg/__init__.py", "virtual/pyvenv.cfg", "virtual/lib/pkg.py", "one/sweep.json"):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text("x")
    elsewhere.mkdir()
    (elsewhere / "secret.py").write_text("x")
    (folder / "my_envs.py").write_text("x")
    for name, target in (
        ("settings", ".env"), ("pkg", ".hidden/pkg"), ("lib", "virtual/lib"), ("result", "one"), ("more", elsewhere),
    ):  # fmt: skip
        (folder / name).symlink_to(target)
    assert names(travel.packed(folder)) == ["my_envs.py"]


def test_what_has_a_name_that_no_zip_file_can_have_stays_here(tmp_path: Path) -> None:
    (tmp_path / "my_envs.py").write_text("x")
    try:
        Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9")).mkdir()
    except OSError:
        pytest.skip("this file system takes no such name")
    for path in (b"/caf\xe9.txt", b"/caf\xe9/inside.py"):
        os.close(os.open(os.fsencode(tmp_path) + path, os.O_CREAT | os.O_WRONLY))
    assert names(travel.packed(tmp_path)) == ["my_envs.py"]

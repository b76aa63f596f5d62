"""Modules that the operator allows are found where the service was started, by those who run its sweeps, too."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CODE = """
import contextlib, os, sys
from policies.envs.modules import import_module_allowed, module_folders
from tune_jobs.service import driver
driver._import_all = lambda: None
with contextlib.ExitStack() as stack:
    driver.warm_up(stack, {"modules": sys.argv[2:], "working_folder": sys.argv[1], "warm_ray": False})
    print(os.getcwd(), *module_folders(), *(import_module_allowed(name).WHERE for name in sys.argv[2:]))
"""


def driver_in(folder: Path, *arguments: object) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-P", "-c", f"import sys; sys.path.insert(0, {str(ROOT)!r}){CODE}", *map(str, arguments)],
        cwd=folder, capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip


@pytest.mark.parametrize("allowed", [True, False])
def test_a_driver_finds_the_module_where_the_service_was_started(tmp_path: Path, *, allowed: bool) -> None:
    start, storage = tmp_path / "start", tmp_path / "storage"
    start.mkdir()
    storage.mkdir()
    (start / "mazes_of_mine.py").write_text("WHERE = 'where it was started'")
    done = driver_in(start, storage, *(["mazes_of_mine"] if allowed else []))
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == (f"{storage} {start} where it was started" if allowed else str(storage))


def test_a_module_of_the_storage_is_no_other_one(tmp_path: Path) -> None:
    """What uploads may write there is not what the operator has allowed."""
    start, storage = tmp_path / "start", tmp_path / "storage"
    start.mkdir()
    storage.mkdir()
    (start / "mazes_of_mine.py").write_text("WHERE = 'start'")
    (storage / "mazes_of_mine.py").write_text("WHERE = 'storage'")
    assert driver_in(start, storage, "mazes_of_mine").stdout.strip() == f"{storage} {start} start"

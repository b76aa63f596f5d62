"""A user's project with folders called `policies` and `analysis`, in the driver and in the processes of trials."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.ray


def test_a_script_beside_folders_of_our_names_runs_on_both_engines(tmp_path: Path) -> None:
    shutil.copytree(Path(__file__).parent / "project", tmp_path, dirs_exist_ok=True)
    done = subprocess.run(
        [sys.executable, "train.py", "packed", "rllib"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["packed completed completed 1.0", "rllib completed completed 1.0"]
    for engine in ("packed", "rllib"):
        assert (tmp_path / "sweeps" / engine / "report" / "index.html").stat().st_size > 10_000
        assert (tmp_path / "sweeps" / engine / "best" / "after.mp4").is_file()

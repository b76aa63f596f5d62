"""What `make` makes of the virtual environment that it finds; nothing is installed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="there is no make")
pytest.importorskip("ensurepip", reason="Debian's python3-venv is missing")


def made(folder: Path) -> str:
    """What `make install` prints in a folder."""
    # Without the options of a `make` that runs the tests.
    environment = {**os.environ, "MAKEFLAGS": ""}
    done = subprocess.run(
        ["make", f"PYTHON={sys.executable}", "INSTALL=@echo install", "COMPILE=true", "install"],
        cwd=folder, env=environment, check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("fault", ["no pip", "no Python"])
def test_a_broken_environment_is_mended_and_a_sound_one_left_alone(tmp_path: Path, fault: str) -> None:
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    venv = tmp_path / ".venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", venv], check=True)
    # Make counted it as done.
    (venv / "installed").touch()
    (library,) = venv.glob("lib/python*")
    (library / "site-packages" / "own").touch()
    if fault == "no Python":
        (venv / "bin" / "python").unlink()
        (venv / "bin" / "python").symlink_to("/usr/bin/python3.1")
        library.rename(library.with_name("python3.1"))

    assert "install --editable ." in made(tmp_path)

    subprocess.run([venv / "bin" / "python", "-m", "pip", "--version"], check=True, capture_output=True)
    assert "install --editable" not in made(tmp_path)
    # Nothing of whoever made it was deleted.
    assert len([*venv.glob("lib/python*/site-packages/own")]) == 1

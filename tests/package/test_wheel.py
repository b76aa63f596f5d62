"""The built wheel, installed into a clean environment, is a working tune-jobs: presets, schema, plan and a sweep."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import venv
from collections.abc import Sequence
from pathlib import Path

import pytest

pytestmark = pytest.mark.package
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clean environment's bin folder, with the wheel and what it depends on, at the tested versions."""
    folder = tmp_path_factory.mktemp("wheel")
    call([sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(ROOT)], folder)
    (wheel,) = folder.glob("*.whl")
    venv.create(folder / "venv")
    binaries = folder / "venv" / "bin"
    constraints = ROOT / "constraints.txt"
    (torch,) = [line for line in constraints.read_text().splitlines() if line.startswith("torch==")]
    # Not compiled by pip, file by file: Python compiles what is imported, a fifth of it.
    pip = [sys.executable, "-m", "pip", "--python", str(binaries / "python")]
    pip += ["install", "--quiet", "--no-compile", "--constraint", str(constraints)]
    call([*pip, torch], folder)
    call([*pip, str(wheel)], folder)
    return binaries


def call(command: Sequence[str], cwd: Path) -> str:
    """Run a command that must succeed, away from the repository; returns its standard output."""
    dropped = ("PYTHONPATH", "VIRTUAL_ENV", "PYTHONDONTWRITEBYTECODE")
    environment = {key: value for key, value in os.environ.items() if key not in dropped}
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{command}: {done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout


def test_presets_schema_and_plan(installed: Path, tmp_path: Path) -> None:
    program = str(installed / "tune-jobs")
    presets = json.loads(call([program, "presets", "--json"], tmp_path))
    assert "cartpole-ppo" in [preset["name"] for preset in presets]
    assert "properties" in json.loads(call([program, "schema"], tmp_path))
    plan = json.loads(call([program, "launch", "cartpole-ppo", "--dry-run", "--json"], tmp_path))
    assert "20" in json.dumps(plan)


def test_a_sweep_from_launch_to_report(installed: Path, tmp_path: Path) -> None:
    program = str(installed / "tune-jobs")
    settings = ["--set", "num_samples=1", "--set", "stop.num_env_steps=4000", "--set", "evaluation.num_episodes=2"]
    result = json.loads(call([program, "launch", "cartpole-ppo", *settings, "--json"], tmp_path))
    # Four, and two that confirm the setting.
    assert [trial["status"] for trial in result["trials"]] == ["completed"] * 6
    report = tmp_path / "sweeps" / "cartpole-ppo" / "report" / "index.html"
    assert report.stat().st_size > 100_000
    assert (report.parents[1] / "best" / "after.mp4").is_file()


def test_a_project_with_folders_of_our_names(installed: Path, tmp_path: Path) -> None:
    """A script beside `policies` and `analysis`, and the command in that folder: both projects' modules are found."""
    shutil.copytree(ROOT / "tests" / "ray" / "project", tmp_path, dirs_exist_ok=True)
    python, program = str(installed / "python"), str(installed / "tune-jobs")
    assert call([python, "train.py", "packed"], tmp_path).split() == ["packed", "completed", "completed", "1.0"]
    (tmp_path / "walk.yaml").write_text(
        "env: policies.walk:Walk\nalgorithm: ppo\nspace: {lr: {grid: [0.001]}}\nstop: {num_env_steps: 2048}\n"
        "evaluation: {num_episodes: 2}\n"
    )
    done = call([program, "launch", "walk.yaml", "--allow-module", "policies.walk", "--json"], tmp_path)
    assert [trial["status"] for trial in json.loads(done)["trials"]] == ["completed"]
    for command in (["report", "packed"], ["evaluate", "packed", "--allow-module", "policies.walk"]):
        call([program, *command], tmp_path)

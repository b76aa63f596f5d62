"""The built wheel, installed into a clean environment, is a working tune-jobs: presets, schema, plan and a sweep."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import venv
from collections.abc import Sequence
from importlib.metadata import Distribution, distribution
from importlib.util import cache_from_source
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

pytestmark = pytest.mark.package
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clean environment's bin folder, with the wheel and what it says that it depends on, at the tested versions."""
    folder = tmp_path_factory.mktemp("wheel")
    call([sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(copy_of_sources(folder))], folder)
    (wheel,) = folder.glob("*.whl")
    venv.create(folder / "venv")
    binaries = folder / "venv" / "bin"
    pip = [sys.executable, "-m", "pip", "--python", str(binaries / "python")]
    call([*pip, "install", "--quiet", "--no-compile", "--no-deps", str(wheel)], folder)
    (packages,) = (folder / "venv" / "lib").glob("python*/site-packages")
    (ours,) = packages.glob("tune_jobs-*.dist-info")
    # Not by pip, which would fetch and unpack gigabytes for two minutes: the files are those of the tests' environment.
    for needed in needed_by(Distribution.at(ours)):
        link_files(needed, packages)
    call([*pip, "check"], folder)
    return binaries


def copy_of_sources(folder: Path) -> Path:
    """Copy what a wheel is built of.

    What an earlier build left in the repository would be packed again, though it is moved or no longer named in
    pyproject.toml; and others may be writing there.
    """
    sources = folder / "sources"
    sources.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, sources)
    for name in ("tune_jobs", "policies", "analysis"):
        shutil.copytree(ROOT / name, sources / name, ignore=shutil.ignore_patterns("__pycache__"))
    return sources


def needed_by(installed: Distribution) -> list[Distribution]:
    """What is needed by a distribution without its extras, directly or not, as it is in the tests' environment."""
    found: dict[str, Distribution] = {}
    asked: set[tuple[str, str]] = set()

    def visit(needs: Distribution, extra: str) -> None:
        for text in needs.requires or ():
            requirement = Requirement(text)
            if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
                continue
            for wanted in ("", *requirement.extras):
                key = (canonicalize_name(requirement.name), wanted)
                if key not in asked:
                    asked.add(key)
                    visit(found.setdefault(key[0], distribution(requirement.name)), wanted)

    visit(installed, "")
    return list(found.values())


def link_files(installed: Distribution, packages: Path) -> None:
    """Let another environment have a distribution's files, without commands, and what Python compiled of them."""
    for file in installed.files or ():
        if ".." in file.parts or file.suffix == ".pyc":
            continue
        source, target = Path(str(file.locate())), packages / file
        link(source, target)
        if file.suffix == ".py" and (compiled := Path(cache_from_source(str(source)))).is_file():
            link(compiled, Path(cache_from_source(str(target))))


def link(source: Path, target: Path) -> None:
    """Let a file have another path, too, with the time by which Python knows whether what it compiled is of now."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        # On another disk.
        shutil.copy2(source, target)


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

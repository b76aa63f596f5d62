"""The examples of the documentation run, each with a small budget."""

import json
import runpy
from pathlib import Path
from typing import Any

import pytest

import tune_jobs
from policies.envs import modules as env_modules

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
# With enough env steps for an evaluation, on which the best is chosen.
SMALL = ["stop.num_env_steps=600", "num_samples=1", "evaluation={num_episodes: 2}"]


@pytest.fixture(autouse=True)
def _nothing_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env_modules, "_allowed", set())


def cells(path: Path) -> list[str]:
    """The code cells of a notebook."""
    found = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in found)
    return ["".join(cell["source"]) for cell in found]


def test_an_environment_of_ones_own(tmp_path: Path) -> None:
    tune_jobs.allow_modules(["maze_envs"])
    result = tune_jobs.launch(EXAMPLES / "own_env" / "maze.yaml", overrides=SMALL, storage=tmp_path, progress="none")
    assert [trial.status for trial in result.trials] == ["completed"] * 2, result.trials[0].error
    assert {"policy", "after_mp4", "report"} <= set(result.artifacts), result.notes


def test_a_module_of_ones_own(tmp_path: Path) -> None:
    tune_jobs.allow_modules(["norm_nets"])
    overrides = [*SMALL, "space.hidden_sizes={grid: [[8]]}"]
    path = EXAMPLES / "own_module" / "norm.yaml"
    result = tune_jobs.launch(path, overrides=overrides, storage=tmp_path, progress="none", finish=False)
    assert [trial.status for trial in result.trials] == ["completed"], result.trials[0].error


def test_a_sweep_from_python(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main = runpy.run_path(str(EXAMPLES / "from_python.py"))["main"]
    assert main(tmp_path, SMALL) > 0
    assert "one episode of the best policy" in capsys.readouterr().out


def test_a_sweep_in_a_notebook(tmp_path: Path) -> None:
    first, *others = cells(EXAMPLES / "sweep.ipynb")
    names: dict[str, Any] = {}
    exec(first, names)
    names |= {"storage": str(tmp_path), "num_env_steps": 600}
    for cell in others:
        exec(cell, names)
    # Six, and three that confirm the setting.
    assert (len(names["trials"]), set(names["trials"].status)) == (9, {"completed"})

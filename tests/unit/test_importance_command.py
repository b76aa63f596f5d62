"""`tune-jobs importance` and `tune_jobs.importance`, on a sweep's folder."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner
from sweep_folders import make_sweep_folder

import tune_jobs
from policies.errors import NotFoundError
from tune_jobs.cli.commands import cli


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep whose later trials score more, whatever their values."""
    made = tmp_path_factory.mktemp("sweeps") / "mine"
    space = {"lr": {"uniform": [1e-4, 1e-2]}, "activation": {"choice": ["tanh", "relu"]}}
    make_sweep_folder(made, iterations=2, num_samples=12, seeds_per_point=1, space=space)
    return made


def run(*arguments: str) -> str:
    result = CliRunner().invoke(cli, ["importance", *arguments])
    assert result.exit_code == 0, result.output
    return result.output


def test_python_gives_the_records_answer(folder: Path) -> None:
    found = tune_jobs.importance(folder)
    assert (found.num_points, found.num_trials, found.objective) == (12, 12, "final")
    assert set(found.names) == {"lr", "activation"}
    assert "12 points are too few to say what mattered" in found.too_few
    assert "may be chance" in found._repr_html_()
    assert "not known" in found._repr_html_()


def test_the_command_prints_the_same(folder: Path) -> None:
    printed = run(str(folder))
    assert printed.startswith("12 points are too few to say what mattered")
    assert "may be chance" in printed
    assert "Scores by value: return in the later half of training; adjusted for the other hyperparameters" in printed
    assert "tanh" in printed


def test_of_too_few_points_nothing_is_said_to_be_adjusted(tmp_path: Path) -> None:
    make_sweep_folder(tmp_path / "few", space={"train_batch_size": {"grid": [2000, 4000]}}, num_samples=1)
    printed = run(str(tmp_path / "few"))
    assert "Scores by value: return in the later half of training\n" in printed
    assert "adjusted for" not in printed


def test_json_has_every_field(folder: Path) -> None:
    told = json.loads(run(str(folder), "--json"))
    assert {item["name"] for item in told["hyperparams"]} == {"lr", "activation"}
    assert {"share", "low", "high", "is_clear"} < set(told["hyperparams"][0])
    assert {level["label"] for effect in told["effects"] for level in effect["levels"]} >= {"tanh", "relu"}
    assert told["too_few"].startswith("12 points")


def test_a_sweep_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError):
        tune_jobs.importance("nothing", storage=tmp_path)

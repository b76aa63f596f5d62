"""What a shell completes: presets, sweep files, sweeps and trials, in the storage folder that stands before them."""

from pathlib import Path

import click
import pytest
from click.shell_completion import ShellComplete
from sweep_folders import make_sweep_folder

from tune_jobs.cli.commands import cli
from tune_jobs.spec.file import list_presets, preset_names


def completed(line: str) -> list[tuple[str, str]]:
    """The kind and the text of each completion of a line's last word."""
    *words, last = line.split(" ")
    found = ShellComplete(cli, {}, "tune-jobs", "_TUNE_JOBS_COMPLETE").get_completions(words, last)
    return [(item.type, str(item.value)) for item in found]


def names(line: str) -> list[str]:
    return [value for kind, value in completed(line) if kind == "plain"]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TUNE_JOBS_STORAGE", raising=False)
    return tmp_path


def test_a_spec_is_a_preset_or_a_sweep_file(here: Path) -> None:
    assert preset_names() == [preset.name for preset in list_presets()]
    assert names("launch ") == preset_names()
    assert names("launch acro") == ["acrobot-dqn", "acrobot-ppo"]
    (here / "acro.yaml").write_text("")
    (here / "acro.txt").write_text("")
    (here / "deep").mkdir()
    (here / "deep" / "own.yml").write_text("")
    assert names("launch --set seed=1 acro") == ["acrobot-dqn", "acrobot-ppo", "acro.yaml"]
    assert names("launch deep/o") == ["deep/own.yml"]
    # Where nothing fits, the shell completes files; bash forgets what comes before that.
    assert completed("launch nothing/like/th") == [("file", "nothing/like/th")]
    assert completed("launch acro")[0][0] == "file"
    assert names("presets cartpole-r") == ["cartpole-random"]


def test_a_sweep_is_one_of_the_storage_folder(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_sweep_folder(here / "sweeps" / "mine", iterations=1)
    make_sweep_folder(here / "other" / "theirs", iterations=1)
    for command in ("status", "trials", "resume", "extend", "stop", "best", "report"):
        assert names(f"{command} ") == ["mine"]
        assert names(f"{command} --storage other ") == ["theirs"]
        assert names(f"{command} --storage other mi") == []
    assert names("resume --retry-failed --storage=other th") == ["theirs"]
    assert completed("status --storage ot") == [("dir", "ot")]
    monkeypatch.setenv("TUNE_JOBS_STORAGE", "other")
    assert names("status ") == ["theirs"]


def test_a_source_is_a_sweep_a_trial_or_a_baseline(here: Path) -> None:
    make_sweep_folder(here / "sweeps" / "mine", iterations=1)
    assert names("evaluate ") == ["random", "constant", "mine"]
    assert names("evaluate --num-episodes 3 mine/t000") == ["mine/t0000", "mine/t0001", "mine/t0002", "mine/t0003"]
    assert names("video mine/t0002") == ["mine/t0002"]
    assert completed("video best/pol") == [("file", "best/pol")]


def test_a_point_is_completed_with_what_the_sweep_searches_and_has_no_value_yet(here: Path) -> None:
    space = {"lr": {"uniform": [1e-4, 1e-2]}, "gamma": {"uniform": [0.9, 0.99]}}
    make_sweep_folder(here / "sweeps" / "mine", iterations=1, space=space)
    assert names("inject mine ") == ["lr=", "gamma="]
    assert names("inject mine lr=1e-3 ") == ["gamma="]
    assert names("inject mine g") == ["gamma="]
    assert names("inject none l") == []
    assert names("inject mi") == ["mine"]


def test_an_algorithm_is_completed() -> None:
    assert names("hyperparams ") == ["ppo", "dqn", "random", "constant"]


def test_what_cannot_be_read_has_nothing_to_complete(here: Path) -> None:
    (here / "sweeps").write_text("a file")
    assert names("status ") == []
    assert names("evaluate sweeps/t") == []
    (here / "broken" / "bad").mkdir(parents=True)
    (here / "broken" / "bad" / "sweep.json").write_text("{")
    assert names("status --storage broken ") == ["bad"]
    assert names("evaluate --storage broken bad/t") == []


def test_completing_allows_no_module(monkeypatch: pytest.MonkeyPatch) -> None:
    allowed: list[tuple[str, ...]] = []
    monkeypatch.setattr("policies.envs.modules.allow_modules", allowed.append)
    assert names("launch --allow-module my_envs acro") == ["acrobot-dqn", "acrobot-ppo"]
    assert allowed == []


def test_every_argument_of_a_command_is_completed() -> None:
    for command in cli.commands.values():
        for parameter in command.params:
            if isinstance(parameter, click.Argument):
                assert parameter._custom_shell_complete is not None, (command.name, parameter.name)

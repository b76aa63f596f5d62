"""What a shell completes: presets, sweep files, sweeps and trials, in the storage folder that stands before them."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.shell_completion import ShellComplete, get_completion_class
from live_service import Live, serving
from sweep_folders import make_sweep_folder

from tests.narrowing import present
from tune_jobs.cli import completion
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
    for name in ("TUNE_JOBS_STORAGE", "TUNE_JOBS_SERVER", "TUNE_JOBS_TOKEN", "HTTP_PROXY", "http_proxy"):
        monkeypatch.delenv(name, raising=False)
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


# -- of a service


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Live]:
    with serving(tmp_path / "there") as made:
        for name in ("mine", "Minor", "other"):
            make_sweep_folder(made.storage / name, iterations=1)
        yield made


def test_sweeps_of_a_service_are_completed_where_one_is_named(
    here: Path, site: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    # On a busy machine an answer may take longer than somebody at a shell would wait.
    monkeypatch.setattr(completion, "_PATIENCE_S", 60.0)
    make_sweep_folder(here / "sweeps" / "mine-here", iterations=1)
    assert names(f"--server {site.url} status ") == ["Minor", "mine", "other"]
    # A service knows no folders of this machine.
    assert completed(f"--server {site.url} status mi") == [("plain", "mine")]
    assert completed(f"--server {site.url} compare o") == [("plain", "other")]
    monkeypatch.setenv("TUNE_JOBS_SERVER", site.url)
    assert names("resume --retry-failed o") == ["other"]
    assert names("compare mine/t000") == ["mine/t0000", "mine/t0001", "mine/t0002", "mine/t0003"]
    assert names("inject mine ") == ["lr="]
    assert names("status x") == names("inject none l") == names("compare none/t") == []
    assert names(f"status {'x' * 200}") == []
    monkeypatch.setenv("TUNE_JOBS_SERVER", "")
    assert names("status mi") == ["mine-here"]


def test_a_service_that_does_not_answer_at_once_is_not_waited_for(
    here: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(completion, "_PATIENCE_S", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        for url in (f"http://127.0.0.1:{silent.getsockname()[1]}", "http://127.0.0.1:1", "no address", "https://a@b"):
            monkeypatch.setenv("TUNE_JOBS_SERVER", url)
            began = time.monotonic()
            assert names("status ") == []
            assert time.monotonic() - began < 3
    # A token that goes without TLS is warned of by commands; here it would stand in the line that is being written.
    monkeypatch.setenv("TUNE_JOBS_TOKEN", "tune-jobs_00000000_" + "A" * 43)
    monkeypatch.setenv("TUNE_JOBS_SERVER", "http://192.0.2.1:1")
    assert names("status ") == []
    assert caplog.records == []
    assert capfd.readouterr() == ("", "")


class Away:
    """A storage that does not answer, as an object store that is tried again and again; and a sweep of it."""

    def sweep(self, _: str) -> "Away":
        return self

    def wait(self) -> list[str]:
        time.sleep(10)
        return []

    sweeps = exists = read_trials = read_record = wait


def test_a_storage_that_does_not_answer_at_once_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(completion, "_PATIENCE_S", 0.3)
    monkeypatch.setattr("tune_jobs.store.opening.open_storage", lambda _: Away())
    monkeypatch.setenv("TUNE_JOBS_STORAGE", "s3://bucket/sweeps")
    began = time.monotonic()
    assert names("status ") == names("export mine/t0") == names("inject mine l") == []
    assert names("evaluate ") == ["random", "constant"]
    assert time.monotonic() - began < 8


# As a shell calls the script, with an object store whose listing comes and whose other answers don't.
HANGS = """
import time
import tune_jobs.store.opening
from tune_jobs.cli.__main__ import main
from tune_jobs.store.objects.at_once import side_by_side

class Hangs:
    def sweeps(self):
        return side_by_side(lambda name: time.sleep(120) or name, ["mine", "other", "third"])

tune_jobs.store.opening.open_storage = lambda _: Hangs()
main()
"""


def test_requests_that_are_on_their_way_are_not_waited_for_at_the_end(here: Path) -> None:
    words = {"_TUNE_JOBS_COMPLETE": "bash_complete", "COMP_WORDS": "tune-jobs\nevaluate\n", "COMP_CWORD": "2"}
    done = subprocess.run(
        [sys.executable, "-c", HANGS], env={**os.environ, "TUNE_JOBS_STORAGE": "s3://bucket/sweeps", **words},
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60, check=False, cwd=here,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "file,\nplain,random\nplain,constant\n", "")


def test_words_that_bash_has_taken_apart_are_put_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """It ends words at colons and equals signs."""
    line = "tune-jobs --server http : //127.0.0.1 : 8470 inject mine --storage = a lr = 0.1 gam"
    monkeypatch.setenv("COMP_WORDS", line.replace(" ", "\n"))
    monkeypatch.setenv("COMP_CWORD", str(line.count(" ")))
    bash = present(get_completion_class("bash"))(cli, {}, "tune-jobs", "_TUNE_JOBS_COMPLETE")
    words = ["--server", "http://127.0.0.1:8470", "inject", "mine", "--storage=a", "lr=0.1"]
    assert bash.get_completion_args() == (words, "gam")


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

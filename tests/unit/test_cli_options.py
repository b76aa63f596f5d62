"""Options that a command does not have, and other words that it can't take."""

import json

import pytest
from fake_sweeps import FakeSweeps, RunCommand


@pytest.mark.parametrize("option", ["--server", "--token-file", "--debug"])
def test_an_option_of_all_commands_is_told_to_go_before_them(run: RunCommand, option: str) -> None:
    done = run("launch", "cartpole-ppo", option, "http://10.0.0.1:8000")
    assert done.exit_code == 2
    assert f"{option} goes before the command: tune-jobs {option} ... launch" in done.stderr
    assert "Did you mean" not in done.stderr


def test_an_option_of_none_is_told_with_its_likes(run: RunCommand) -> None:
    done = run("launch", "cartpole-ppo", "--storag", "here")
    assert done.exit_code == 2
    assert "No such option" in done.stderr
    assert "--storage" in done.stderr


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("list --json --bogus", "No such option"),
        ("list --bogus --json", "No such option"),
        ("trials x --top --json", "'--json' is not a valid integer"),
        ("trials x --json --top", "requires an argument"),
        ("lst --json", "No such command"),
        ("--bogus list --json", "No such option"),
        ("token lst --json", "No such command"),
        ("launch cartpole-ppo --debug --json", "--debug goes before the command"),
    ],
)
def test_words_that_cannot_be_parsed_are_told_as_json_too(run: RunCommand, words: str, told: str) -> None:
    done = run(*words.split())
    document = json.loads(done.stdout)
    assert done.exit_code == document["exit_code"] == 2
    assert told in document["error"]
    assert told in done.stderr


@pytest.mark.parametrize("words", ["list --bogus", "presets nope", "trials x --top", "lst", "list --bogus -- --json"])
def test_without_json_an_error_goes_to_standard_error_alone(run: RunCommand, words: str) -> None:
    done = run(*words.split())
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr


def test_json_as_the_value_of_an_option_asks_for_none(run: RunCommand, sweeps: FakeSweeps) -> None:
    done = run("launch", "nowhere.yaml", "--dry-run", "--set", "--json")
    assert (done.exit_code, done.stdout) == (2, "")


def test_a_point_of_which_a_value_is_only_a_comment_is_refused(run: RunCommand, sweeps: FakeSweeps) -> None:
    done = run("inject", "mine", "lr=0.1", "color=#ff0000")
    assert (done.exit_code, sweeps.calls) == (2, [])
    assert "color=#ff0000: #ff0000 is a comment in YAML, so there is no value" in done.stderr
    run("inject", "mine", "lr=0.1", "color='#ff0000'")
    (call,) = sweeps.calls
    assert call[1] == ("mine", {"lr": 0.1, "color": "#ff0000"})

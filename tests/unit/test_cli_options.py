"""Options that a command does not have."""

import pytest
from fake_sweeps import RunCommand


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

"""What the hooks of the site draw of the command line."""

import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest

from tests.narrowing import present
from tune_jobs.cli.commands import cli

HOOKS = Path(__file__).parents[2] / "docs" / "hooks"


@pytest.fixture(scope="module")
def drawn() -> str:
    """The table of commands; as MkDocs does, the hook is loaded by its file."""
    spec = present(importlib.util.spec_from_file_location("site_tables", HOOKS / "site_tables.py"))
    module = importlib.util.module_from_spec(spec)
    present(spec.loader).exec_module(module)
    text: Any = module.commands()
    assert isinstance(text, str)
    return text


def with_inner(words: str, command: click.Command) -> Iterator[tuple[str, click.Command]]:
    yield words, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from with_inner(f"{words} {name}", inner)


def test_each_command_is_drawn_with_its_options_and_the_groups_own_come_first(drawn: str) -> None:
    parts = re.split(r"^### (.*)$", drawn, flags=re.MULTILINE)
    shown = dict(zip(parts[1::2], parts[2::2], strict=True))
    commands = {words.removeprefix("tune-jobs "): command for words, command in with_inner("tune-jobs", cli)}
    assert list(shown) == list(commands)
    assert next(iter(shown)) == "tune-jobs"
    missing = {
        f"{name} {option}"
        for name, command in commands.items()
        for parameter in command.params
        if isinstance(parameter, click.Option) and not parameter.hidden
        for option in parameter.opts
        if not re.search(rf"^  (?:.*[ ,])?{re.escape(option)}\b", shown[name], re.MULTILINE)
    }
    assert missing == set()
    assert "Usage: tune-jobs token make [OPTIONS] NAME" in shown["token make"]


def test_each_variable_of_the_environment_that_stands_for_an_option_is_drawn(drawn: str) -> None:
    options = [item for _, command in with_inner("tune-jobs", cli) for item in command.params]
    variables = {item.envvar for item in options if item.envvar is not None}
    assert {"TUNE_JOBS_SERVER", "TUNE_JOBS_TOKEN_FILE", "TUNE_JOBS_CA_FILE", "TUNE_JOBS_DATABASE"} <= variables
    assert {name for name in variables if str(name) not in drawn} == set()

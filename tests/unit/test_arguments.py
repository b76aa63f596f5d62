"""The Python API answers a wrong argument, whichever it is, by its name and with what it takes."""

import inspect
import re
from pathlib import Path
from typing import Any, cast

import click
import numpy as np
import pytest
from spec_errors import MINIMAL

import tune_jobs
from policies.arguments import NumEpisodes, Seed, checked
from policies.errors import SpecError, TuneJobsError
from tune_jobs.cli.commands import cli

FUNCTIONS = {name: thing for name in tune_jobs._HOME if inspect.isfunction(thing := getattr(tune_jobs, name))}

# -- what each argument takes, by kinds of values

VALUES: dict[str, Any] = {
    "none": [None],
    "flag": [True, False, np.bool_(True)],
    "whole": [3, np.int64(3), np.array(3)],
    "zero": [0],
    "negative": [-1, np.int32(-1)],
    "huge": [2**40],
    "fraction": [1.5, np.float32(2.5)],
    "not finite": [float("nan"), float("inf"), np.nan],
    "empty text": [""],
    "text": ["x", "loud"],
    "no path": ["x\0y", "x" * 5_000, "a/" * 5_000],
    "path": [Path("x")],
    "bytes": [b"x", bytearray(b"x")],
    "object": [object(), len, lambda: None, Ellipsis, 1j],
    "class": [int],
    "empty list": [[], ()],
    "numbers": [[1, 2.5], (3,), np.array([0.5])],
    "texts": [["a=1"], ("a", "b")],
    "mixed": [["a", 3], [None], [object()], [[1]], [b"x"]],
    "empty mapping": [{}],
    "mapping": [{"x": 1}],
    "set": [{"x"}],
}
PATH = {"text", "path"}
TAKES = {
    "source": PATH,
    "sweep": PATH,
    "path": PATH,
    "storage": PATH | {"none"},
    "output": PATH | {"none"},
    "html": PATH | {"none"},
    "sources": PATH | {"texts", "empty list"},
    "sweeps": PATH | {"texts", "empty list"},
    "objective": {"none"},
    "rows": set(),
    "format": set(),
    "returns": set(),
    "width": {"whole", "fraction"},
    "height": {"whole", "fraction"},
    "wait_for_nodes": {"whole", "fraction", "zero"},
    # Any text is a name, an address or an id as far as its kind goes.
    "name": {"text", "none", "empty text", "no path"},
    "address": {"text", "none", "empty text", "no path"},
    "race": {"text", "none", "empty text", "no path"},
    "env_id": {"text", "none", "empty text", "no path"},
    "rl_module": {"text", "none", "empty text", "no path", "class"},
    "overrides": {"texts", "empty list"},
    "names": {"texts", "empty list", "set"},
    "progress": set(),
    "finish": {"flag"},
    "point": {"mapping", "empty mapping"},
    "retry_failed": {"flag"},
    "num_samples": {"whole", "huge"},
    "top": {"whole", "huge"},
    "seeds": {"whole", "huge"},
    "num_episodes": {"whole"},
    "first_seed": {"whole", "zero", "none"},
    "seed": {"whole", "zero", "none"},
    "action": {"whole", "zero", "negative", "huge", "numbers", "empty list", "none"},
}
MORE = {(name, "source"): {"mapping", "empty mapping"} for name in ("create", "launch", "load_spec")}
MORE[("export", "top")] = MORE[("export", "format")] = {"none"}
CASES = [
    (name, argument) for name, function in FUNCTIONS.items() for argument in inspect.signature(function).parameters
]


def call(name: str, argument: str, value: Any) -> Any:
    function = FUNCTIONS[name]
    given: dict[str, Any] = {
        key: "nothing" for key, one in inspect.signature(function).parameters.items() if one.default is one.empty
    }
    given |= {"num_samples": 1} if "num_samples" in given else {}
    given |= {"point": {"lr": 1}} if "point" in given else {}
    given |= {"format": "csv"} if "format" in given else {}
    return function(**{**given, argument: value})


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty folder, in which no sweep is found."""
    monkeypatch.chdir(tmp_path)


def test_the_whole_api_is_looked_at() -> None:
    assert len(FUNCTIONS) == 27
    assert {argument for _, argument in CASES} == set(TAKES)


@pytest.mark.parametrize(("name", "argument"), CASES)
def test_a_value_of_a_wrong_kind_is_refused_by_the_arguments_name(name: str, argument: str) -> None:
    taken = TAKES[argument] | MORE.get((name, argument), set())
    wrong = [value for kind, values in VALUES.items() if kind not in taken for value in values]
    for value in wrong:
        with pytest.raises(SpecError) as caught:
            call(name, argument, value)
        assert caught.value.message.startswith(f"The argument {argument} is "), value
        assert caught.value.hint.startswith("Give ")


@pytest.mark.parametrize(("name", "argument"), CASES)
def test_a_value_of_the_right_kind_gives_at_most_an_error_of_ours(name: str, argument: str) -> None:
    taken = TAKES[argument] | MORE.get((name, argument), set())
    for kind in sorted(taken - {"class"}):
        for value in VALUES[kind]:
            try:
                call(name, argument, value)
            except TuneJobsError as error:
                assert not error.message.startswith("The argument"), value  # noqa: PT017 - any error of ours is right


def test_what_is_given_wrong_often_is_told_in_words() -> None:
    with pytest.raises(SpecError) as caught:
        tune_jobs.launch(MINIMAL, progress="loud")  # type: ignore[arg-type]
    assert str(caught.value) == "The argument progress is 'loud'.\nGive 'auto' or 'none'."
    with pytest.raises(SpecError) as caught:
        tune_jobs.allow_modules("my_envs")
    assert str(caught.value) == "The argument names is 'my_envs'.\nGive a list, each of its items a text."
    with pytest.raises(SpecError) as caught:
        tune_jobs.best("x", num_episodes=0)
    assert str(caught.value) == "The argument num_episodes is 0.\nGive a whole number from 1 to 262,144."
    with pytest.raises(SpecError) as caught:
        tune_jobs.launch(3)  # type: ignore[arg-type]
    path = "a name or path (not empty, each part at most 255 bytes)"
    assert caught.value.hint == f"Give {path} or a mapping or a SweepSpec."
    with pytest.raises(SpecError, match="overrides is 'a=1'"):
        tune_jobs.load_spec(MINIMAL, "a=1")


# -- the command line

COMMANDS = {"list_sweeps": "list", "list_presets": "presets"}
"""Of the functions that are not called as theirs is."""

EVERYWHERE = {"--allow-module": None, "--json": None, "--detach": None, "--env": "env_id", "--out": "output"}
RENAMED: dict[str, dict[str, str | None]] = {
    "launch": {"SPEC": "source", "--set": "overrides", "--dry-run": None},
    "inject": {"VALUES": "point"},
    "report": {"--output": None},
    "trials": {"--sort": None, "--top": None},
    "list_presets": {"NAME": None},
}
"""What the option or the argument of a command is called in Python; None: there is none. The page has each."""
IN_PYTHON_ALONE = {("launch", "rl_module"), ("replicate", "race")}


def of_command(name: str) -> set[str]:
    """The options of a function's command, each by its longest name, and its arguments in capital letters."""
    found = set()
    for parameter in cli.commands[COMMANDS.get(name, name)].params:
        is_argument = isinstance(parameter, click.Argument)
        found.add(str(parameter.name).upper() if is_argument else max(parameter.opts, key=len))
    return found


PAGE = (Path(__file__).parents[2] / "docs" / "python.md").read_text()
SECTION = PAGE.partition("## Functions\n")[2].partition("\n## ")[0]


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if COMMANDS.get(name, name) in cli.commands])
def test_a_function_takes_what_its_command_does_but_for_what_the_page_says(name: str) -> None:
    other = EVERYWHERE | RENAMED.get(name, {})
    options = of_command(name)
    expected = {other.get(option, option.lstrip("-").replace("-", "_").lower()) for option in options} - {None}
    expected |= {argument for function, argument in IN_PYTHON_ALONE if function == name}
    assert set(inspect.signature(FUNCTIONS[name]).parameters) == expected
    assert RENAMED.get(name, {}).keys() <= options
    assert f"`{name}`" in SECTION.partition(" are functions named like the commands")[0]
    code = re.findall(r"`([^`]+)`", SECTION)
    for option in options & other.keys():
        assert any(option in text.split() for text in code), option
        assert other[option] is None or other[option] in code


def test_the_page_names_the_functions_that_have_a_command() -> None:
    listed = re.findall(r"`(\w+)`", SECTION.partition(" are functions named like the commands")[0])
    assert set(listed) == {name for name in FUNCTIONS if COMMANDS.get(name, name) in cli.commands}
    assert all(f"`{argument}`" in SECTION for _, argument in IN_PYTHON_ALONE)


def test_the_jobs_api_is_for_the_command_line() -> None:
    assert "`http://...`" in SECTION
    with pytest.raises(SpecError, match="is not the address of a Ray cluster"):
        tune_jobs.launch(MINIMAL, address="http://127.0.0.1:1")


# -- the decorator


@checked
def example(
    count: NumEpisodes, seed: Seed | None = None, *, items: "list[int] | None" = None, flag: bool = False
) -> tuple[int, int | None, list[int] | None, bool]:
    return count, seed, items, flag


def test_numpys_numbers_arrive_as_pythons() -> None:
    given = example(cast("Any", np.int64(3)), cast("Any", np.uint8(4)), flag=cast("Any", np.bool_(True)))
    assert given == (3, 4, None, True)
    assert [type(value) for value in given] == [int, int, type(None), bool]


def test_a_checked_function_keeps_its_signature_and_pythons_own_errors() -> None:
    assert list(inspect.signature(example).parameters) == ["count", "seed", "items", "flag"]
    words = r"^example\(\) missing a required argument: 'count': it takes count, seed, items, flag\.$"
    with pytest.raises(TypeError, match=words):
        example()  # type: ignore[call-arg]
    with pytest.raises(TypeError, match=r"example\(\) .* 'item': it takes .*\. Did you mean 'items'\?$"):
        example(1, item=2)  # type: ignore[call-arg]


def test_numbers_that_are_too_small_are_no_errors_where_the_caller_wants_them_to_be() -> None:
    @checked
    def tiny() -> float:
        return float(np.exp(np.float64(-1_000)))

    with np.errstate(all="raise"):
        before = np.geterr()
        with pytest.raises(FloatingPointError):
            inspect.unwrap(tiny)()
        assert tiny() == 0.0
        assert np.geterr() == before


def test_numpys_numbers_are_taken_by_the_api(tmp_path: Path) -> None:
    with pytest.raises(TuneJobsError, match="No sweep"):
        tune_jobs.extend("x", np.int64(3), finish=np.bool_(False))  # type: ignore[arg-type]
    first, _ = tune_jobs.evaluate(
        "random", env_id="CartPole-v1", num_episodes=cast("Any", np.int64(2)), first_seed=cast("Any", np.array(5))
    )
    assert first.seeds == (5, 6)

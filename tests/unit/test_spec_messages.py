"""Whatever is wrong in whichever field: it is said in the words of a sweep file, not in those of the library below."""

import pickle
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest
import yaml
from pydantic import BaseModel
from spec_errors import MINIMAL, write

from policies.errors import SpecError
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM, Algorithm
from tests.narrowing import present
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import TrialPlan, make_plan  # type: ignore[attr-defined]
from tune_jobs.spec.domains import DOMAIN_KINDS
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec

FOREIGN = re.compile(
    r"should be a valid|instance of|input should|field required|extra inputs|type=|value error|pydantic|dictionary|"
    r"\b(tuple|string|integer|boolean|dict|str|int)\b|(List|Tuple|String) should|validat|unable to|"
    r"[A-Z]\w+(Spec|Hyperparams)\b|should match pattern|\bmodel\b",
    re.IGNORECASE,
)
WRONG: list[Any] = [
    None, True, 0, -1, 3, 1.5, -0.5, 10**39, float("nan"), float("inf"), "", "x", "no", "3", "010", [], [None], [[]],
    [0], ["x"], [1.5], [True], [1, 2, 3], [3, 2, 1, 0, -1], {}, {"x": 1}, {"id": 3}, {"type": None}, {"grid": 3},
]  # fmt: skip


def sections(model: type[BaseModel] = SweepSpec, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The path of every field of the sweep file."""
    for name, field in model.model_fields.items():
        yield (*path, name)
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from sections(field.annotation, (*path, name))


def with_value(path: tuple[str, ...], value: Any) -> dict[str, Any]:
    data = {**MINIMAL, "env": {"id": "CartPole-v1"}}
    *parents, last = path
    section = data
    for parent in parents:
        section = section.setdefault(parent, {})
    section[last] = value
    return data


def problem_with(data: dict[str, Any]) -> str | None:
    """The message, or None if it is right; nothing but a message may come."""
    try:
        load_spec(data)
    except SpecError as error:
        return error.message
    return None


def shown_without_values(message: str) -> str:
    """The message without what it quotes: that is the user's own."""
    return re.sub(r"'[^']*'|\"[^\"]*\"", "", message)


@pytest.mark.parametrize("path", list(sections()), ids=".".join)
def test_no_field_of_the_sweep_file_answers_in_foreign_words(path: tuple[str, ...]) -> None:
    told = [(value, problem_with(with_value(path, value))) for value in WRONG]
    # A field that takes anything would make this say nothing.
    assert any(message is not None for _, message in told)
    for value, message in told:
        if message is not None:
            assert not FOREIGN.search(shown_without_values(message)), (value, message)
            assert path[0] in message, (value, message)


@pytest.mark.parametrize(
    ("algorithm", "name"),
    [(algorithm, name) for algorithm, model in HYPERPARAMS_BY_ALGORITHM.items() for name in model.model_fields],
)
def test_no_hyperparameter_does(algorithm: Algorithm, name: str) -> None:
    refused = 0
    for value in WRONG:
        fixed = {**MINIMAL, "algorithm": algorithm, "hyperparams": {name: value}}
        searched = {**MINIMAL, "algorithm": algorithm, "space": {name: {"grid": [value]}}}
        for message in (problem_with(fixed), problem_with(searched)):
            if message is not None:
                refused += 1
                assert not FOREIGN.search(shown_without_values(message)), (value, message)
                assert name in message, (value, message)
    assert refused > len(WRONG)


@pytest.mark.parametrize("kind", DOMAIN_KINDS)
def test_no_domain_does(kind: str) -> None:
    for value in [*WRONG, [1], [1, 2, 3, 4], ["a", "b"], [None, 1], [2, 1], [0.1, 0.2, 0], [1e-4, 1e-3]]:
        message = problem_with({**MINIMAL, "space": {"lr": {kind: value}}})
        if message is not None:
            assert not FOREIGN.search(shown_without_values(message)), (value, message)
            assert f"space.lr.{kind}" in message, (value, message)


@pytest.mark.parametrize("value", WRONG)
def test_no_whole_sweep_does(value: Any) -> None:
    message = problem_with(value) if isinstance(value, dict) else problem_with({**MINIMAL, "space": {"lr": value}})
    if message is not None:
        assert not FOREIGN.search(shown_without_values(message)), message


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"stop": [1]}, "stop: [1] is not allowed: give a mapping of its fields (training_return, "),
        (
            {"search": False},
            "search: False is not allowed: give random, auto, gp, forest or tpe, or a mapping",
        ),
        ({"env": 3}, "env: 3 is not allowed: give a Gymnasium id such as CartPole-v1, or a mapping of id and args"),
        ({"env": {"id": "x", "pixels": "yes"}}, "env.pixels: 'yes' is not allowed: it should be true or false"),
        ({"rl_module": "x"}, "rl_module: 'x' is not allowed: write module:Class"),
        (
            {"hyperparams": {"hidden_sizes": "64x64"}},
            "hyperparams.hidden_sizes: '64x64' is not allowed: it should be a",
        ),
        (
            {"hyperparams": {"hidden_sizes": []}},
            "hyperparams.hidden_sizes: [] is not allowed: it should have at least 1",
        ),
        (
            {"hyperparams": {"num_epochs": 2.5}},
            "hyperparams.num_epochs: 2.5 is not allowed: it should be a whole number",
        ),
        ({"hyperparams": {"conv_filters": [[8, 4]]}}, "hyperparams.conv_filters[0][2]: is missing"),
        ({"space": {"lr": {"uniform": [0.1]}}}, "space.lr.uniform[1]: is missing"),
        (
            {"space": {"lr": {"uniform": [0.1, 1, 2]}}},
            "space.lr.uniform: [0.1, 1, 2] is not allowed: it should have at",
        ),
        ({"space": {"lr": {"grid": 3}}}, "space.lr.grid: 3 is not allowed: it should be a list"),
        ({"space": [1]}, "space: [1] is not allowed: it should be a mapping of names to values"),
    ],
)
def test_what_is_said_of_common_mistakes(fields: dict[str, Any], message: str) -> None:
    assert f"sweep: {message}" in present(problem_with({**MINIMAL, **fields}))


@pytest.mark.parametrize(
    ("kind", "ends", "wanted"),
    [
        ("uniform", [1, 64], "randint"),
        ("loguniform", [1, 64], "lograndint, qlograndint or power_of_two"),
        ("quniform", [1, 64, 0.5], "qrandint"),
        ("qloguniform", [1, 64, 0.5], "qlograndint"),
    ],
)
def test_a_range_that_gives_fractions_is_answered_with_its_counterpart_of_whole_numbers(
    kind: str, ends: list[float], wanted: str
) -> None:
    for name in ("num_epochs", "stop.num_env_steps"):
        message = present(problem_with({**MINIMAL, "space": {name: {kind: ends}}}))
        assert f"but {name} must be a whole number: use {wanted} in place of {kind}" in message
        assert "log form" not in message


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        (
            {"stop.evaluation_return": 100},
            "no field 'stop.evaluation_return' here: write stop: {evaluation_return: ...}",
        ),
        ({"search.num_startup_trials": 3}, "here: write search: {num_startup_trials: ...}"),
        ({"hyperparams.lr": 1e-3}, "here: write hyperparams: {lr: ...}"),
        ({"env.args.size": 5}, "here: write env: {args: {size: ...}}"),
        ({"env.atari.frame_skip": 5}, "here: write env: {atari: {frame_skip: ...}}"),
        ({"space.stop.num_env_steps": {"grid": [5]}}, "here: write space: {stop.num_env_steps: ...}"),
        (
            {"env": {"id": "x", "args.size": 5}},
            "env.args.size: there is no field 'args.size' here: write args: {size: ",
        ),
        (
            {"stop.evaluation_retrun": 100},
            "'stop.evaluation_retrun' here, nor 'evaluation_retrun' in stop. Did you mean 'evaluation_return'?",
        ),
        ({"search.num_env_steps": 5}, "nor 'num_env_steps' in search. Did you mean stop.num_env_steps?"),
        ({"stpo.time_s": 5}, "there is no field 'stpo.time_s' here. Did you mean 'stop'?"),
        ({"seed.time_s": 5}, "there is no field 'seed.time_s' here. Did you mean 'seed'?"),
    ],
)
def test_a_dotted_key_is_written_in_braces_and_nothing_is_guessed_across_the_dot(
    fields: dict[str, Any], told: str
) -> None:
    assert told in present(problem_with({**MINIMAL, **fields}))


@pytest.mark.parametrize(
    ("fields", "told", "followed"),
    [
        (
            {"space.lr.loguniform": [1e-4, 1e-2]},
            "write space: {lr: {loguniform: ...}}",
            {"space": {"lr": {"loguniform": [1e-4, 1e-2]}}},
        ),
        (
            {"space.stop.num_env_steps.choice": [3000, 4000]},
            "write space: {stop.num_env_steps: {choice: ...}}",
            {"space": {"stop.num_env_steps": {"choice": [3000, 4000]}}},
        ),
        (
            {"space": {"num_epochs": {"grid": [2, 3]}}, "space.lr.when": {"num_epochs": 2}},
            "write space: {lr: {when: ...}}",
            {"space": {"num_epochs": {"grid": [2, 3]}, "lr": {"uniform": [0.1, 1], "when": {"num_epochs": 2}}}},
        ),
        ({"space.lr": {"grid": [0.1]}}, "write space: {lr: ...}", {"space": {"lr": {"grid": [0.1]}}}),
    ],
)
def test_a_dotted_key_of_the_space_is_written_with_its_domain_in_braces(
    fields: dict[str, Any], told: str, followed: dict[str, Any]
) -> None:
    assert present(problem_with({**MINIMAL, **fields})).endswith(told)
    assert problem_with({**MINIMAL, **followed}) is None


IN_QUOTES = "put the name in quotes as you wrote it, '...', and on a command line in two pairs, \"'...'\""


@pytest.mark.parametrize("prior", [2024, [2024]])
def test_the_name_of_a_sweep_that_is_a_number_is_put_in_quotes(tmp_path: Path, prior: Any) -> None:
    told = f"is read as the number 2024: {IN_QUOTES}"
    assert problem_with({**MINIMAL, "name": 2024}) == f"sweep: name: {told}"
    assert load_spec(write(tmp_path, "env: CartPole-v1\nalgorithm: ppo\nname: '2024'\n")).name == "2024"
    # The shell has taken a pair of them.
    with pytest.raises(SpecError, match=re.escape(f"name: {told} (from --set)")):
        load_spec(MINIMAL, ["name=2024"])
    assert load_spec(MINIMAL, ["name='2024'"]).name == "2024"
    searched = {**MINIMAL, "search": "gp", "num_samples": 12, "space": {"lr": {"uniform": [0.1, 0.2]}}}
    assert told in present(problem_with({**searched, "prior": prior}))
    assert load_spec({**searched, "prior": "2024"}).prior == ("2024",)


@pytest.mark.parametrize("written", ["1.10", "2024_01", "1e5", "0x10", "1e30"])
def test_no_other_name_is_told_for_one_that_is_read_as_a_number(tmp_path: Path, written: str) -> None:
    """The number's own text, such as 1.1 for 1.10, would name another sweep."""
    searched = {**MINIMAL, "search": "gp", "num_samples": 12, "space": {"lr": {"uniform": [0.1, 0.2]}}}
    number = float(written) if "x" not in written else int(written, 16)
    for field, value in (("name", written), ("prior", written), ("prior", f"[first, {written}]")):
        file = write(tmp_path, yaml.safe_dump(searched) + f"{field}: {value}\n")
        for source, overrides in ((searched, [f"{field}={value}"]), (file, [])):
            with pytest.raises(SpecError) as caught:
                load_spec(source, overrides)
            (line,) = (line for line in caught.value.message.splitlines() if "is read as" in line)
            read, _, advice = line.partition(": is read as the number ")[2].partition(": ")
            assert advice.removesuffix(" (from --set)") == IN_QUOTES
            assert float(read) == number
        quoted = value.replace(written, f"'{written}'")
        for source, overrides in (
            (searched, [f"{field}={quoted}"]),
            (write(tmp_path, yaml.safe_dump(searched) + f"{field}: {quoted}\n"), []),
        ):
            assert written in (getattr(load_spec(source, overrides), field) or ())


@pytest.mark.parametrize("name", [-1, True])
def test_what_no_quotes_make_a_name_is_told_how_a_name_is(name: Any) -> None:
    assert "is not allowed: use up to 100 letters, digits" in present(problem_with({**MINIMAL, "name": name}))


@pytest.mark.parametrize(
    ("name", "suggestion"),
    [
        ("stop.num_env_step", " Did you mean 'stop.num_env_steps'?"),
        ("stop.time_s", ""),
        ("stop.num_episodes", ""),
        ("stop.evaluation_return", ""),
    ],
)
@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_of_stop_only_the_length_of_training_is_searched(algorithm: str, name: str, suggestion: str) -> None:
    message = present(problem_with({**MINIMAL, "algorithm": algorithm, "space": {name: {"grid": [1, 2]}}}))
    only = f"Of stop, only stop.num_env_steps can be searched, under space; all else is fixed under stop.{suggestion}"
    assert message == f"sweep: space.{name}: {algorithm} has no hyperparameter {name!r}. {only}"


def test_a_dotted_name_of_a_hyperparameter_is_compared_part_by_part() -> None:
    assert "Did you mean 'lr'?" in present(problem_with({**MINIMAL, "hyperparams": {"ppo.lr": 1e-3}}))
    message = present(problem_with({**MINIMAL, "space": {"lr.loguniform": {"grid": [1]}, "a.b": {"grid": [1]}}}))
    assert "'lr.loguniform'. Did you mean 'lr'?" in message
    assert "'a.b'. It has activation" in message


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        ("hyperparams: {lr:1e-3}", "hyperparams.lr:1e-3: ppo has no hyperparameter 'lr:1e-3': write a space after the"),
        ("hyperparams: {lr:1e-3}", "after the colon, lr: 1e-3"),
        ("hyperparams:\n  lr:1e-3", "hyperparams: 'lr:1e-3' is one word: write a space after the colon, lr: 1e-3"),
        ("hyperparams:\n  lr:1e-3\n  gamma:0.9", "gamma:0.9' is one word: write a space after the colon, lr: 1e-3"),
        ("space:\n  lr:1e-3", "space: 'lr:1e-3' is one word: write a space after the colon, lr: 1e-3"),
        ("stop: {time_s:60}", "there is no field 'time_s:60' here: write a space after the colon, time_s: 60"),
        ("stop:\n  time_s:60", "stop: 'time_s:60' is one word: write a space after the colon, time_s: 60"),
        (
            "env: {id: CartPole-v1, args: size:5}",
            "args: 'size:5' is one word: write a space after the colon, size: 5",
        ),
    ],
)
def test_a_missing_space_after_a_colon_is_told(tmp_path: Path, lines: str, told: str) -> None:
    env = "" if lines.startswith("env") else "env: CartPole-v1\n"
    with pytest.raises(SpecError) as caught:
        load_spec(write(tmp_path, f"{env}algorithm: ppo\n{lines}\n"))
    assert told in caught.value.message
    assert "It has activation" not in caught.value.message


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"num_samples": "4"}, "num_samples: '4' is of the wrong type: write 4 if that is meant"),
        ({"hyperparams": {"lr": "3e-4"}}, "hyperparams.lr: '3e-4' is of the wrong type: write 0.0003 if that is meant"),
        (
            {"space": {"lr": {"loguniform": ["1e-4", 1]}}},
            "[0]: '1e-4' is of the wrong type: write 0.0001 if that is me",
        ),
        ({"num_samples": "1,000"}, "num_samples: '1,000' is of the wrong type: write 1000 if that is meant"),
        ({"stop": {"time_s": "1e999"}}, "stop.time_s: '1e999' is not a number"),
        ({"stop": {"time_s": "nan"}}, "stop.time_s: 'nan' is not a number"),
        ({"stop": {"time_s": "1,5"}}, "stop.time_s: '1,5' is not a number"),
    ],
)
def test_a_number_in_quotes_is_answered_in_one_wording(fields: dict[str, Any], told: str) -> None:
    assert told in present(problem_with({**MINIMAL, **fields}))


def test_what_is_no_field_of_env_may_be_an_argument_of_the_environment() -> None:
    message = present(problem_with({**MINIMAL, "env": {"id": "CartPole-v1", "size": 5}}))
    assert message.endswith("failure_penalty. Arguments of the environment go under env.args.")
    message = present(problem_with({**MINIMAL, "env": {"id": "CartPole-v1", "frame_stak": 5}}))
    assert "Did you mean 'frame_stack'? Arguments of the environment go under env.args." in message


def test_a_search_that_is_no_is_told_where_it_stands(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=r"sweep.yaml, line 3, column 9: no may mean false or a text"):
        load_spec(write(tmp_path, "env: CartPole-v1\nalgorithm: ppo\nsearch: no\n"))


# -- one number where a list of one is meant


def planned(**fields: Any) -> tuple[TrialPlan, ...]:
    return make_plan(load_spec({**MINIMAL, **fields}), Machine(2)).trials


def test_one_hidden_size_is_one_hidden_layer() -> None:
    (fixed,) = planned(hyperparams={"hidden_sizes": 8})
    assert fixed.hyperparams["hidden_sizes"] == [8]
    trials = planned(space={"hidden_sizes": {"grid": [64, [32, 32], 128]}})
    assert [trial.hyperparams["hidden_sizes"] for trial in trials] == [[64], [32, 32], [128]]
    (drawn,) = planned(space={"hidden_sizes": {"randint": [8, 10]}})
    assert drawn.hyperparams["hidden_sizes"] in ([8], [9])
    for search in ("hidden_sizes: {choice: [8, 16]}", "hidden_sizes: {lograndint: [8, 16]}"):
        overrides = [f"space={{lr: {{uniform: [0.1, 0.2]}}, {search}}}", "search=tpe", "num_samples=20"]
        assert len(make_plan(load_spec(MINIMAL, overrides), Machine(2)).trials) == 20


def test_one_number_is_a_continuous_action() -> None:
    fields = {"env": "Pendulum-v1", "algorithm": "constant", "hyperparams": {"action": 0.5}}
    assert make_plan(load_spec(fields), Machine(1)).trials[0].hyperparams["action"] == [0.5]


# -- a spec that is made in Python


@pytest.mark.parametrize("make", [lambda fields: SweepSpec(**fields), SweepSpec.model_validate])
def test_a_spec_that_is_made_in_python_is_told_in_the_same_words(make: Callable[..., Any]) -> None:
    wrong = {**MINIMAL, "algorithm": "pp0", "stop": 3, "enviroment": 1, "space": {"lr": {"uniform": [1]}}}
    with pytest.raises(SpecError) as caught:
        make(wrong)
    message = caught.value.message
    assert message.startswith("SweepSpec: 4 problems:\n  ")
    assert "algorithm: 'pp0' is not allowed: it should be 'ppo', 'dqn'" in message
    assert "enviroment: there is no field 'enviroment' here. Did you mean 'env'?" in message
    assert not FOREIGN.search(shown_without_values(message.removeprefix("SweepSpec")))
    again = pickle.loads(pickle.dumps(caught.value))
    assert (again.message, again.hint, again.problems) == (
        message,
        caught.value.hint,
        cast("Any", caught.value).problems,
    )
    with pytest.raises(SpecError):
        SweepSpec.model_validate(3)

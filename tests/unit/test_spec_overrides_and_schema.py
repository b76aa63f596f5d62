"""Sweep files: `--set`, and their JSON Schema."""

from collections.abc import Iterator
from typing import Any, cast, get_args

import pytest
from pydantic import BaseModel
from spec_errors import MINIMAL, errors

from policies.errors import SpecError
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM, Algorithm
from tune_jobs.spec.domains import DOMAIN_KINDS
from tune_jobs.spec.fields import Section
from tune_jobs.spec.file import json_schema, list_presets, load_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.spec.yaml import parse_yaml

# -- --set


def test_set_overrides_and_creates_fields() -> None:
    spec = load_spec(
        "cartpole-ppo",
        [
            "stop.num_env_steps=1000",
            "env=CartPole-v1",
            "env.args.sutton_barto_reward=true",
            "scheduler=asha",
            "scheduler.grace_env_steps=50",
            "space.lr={grid: [1e-3, 2e-3]}",
            "resources.max_concurrent=1",
            "hyperparams.grad_clip=null",
            "name=ab",
        ],
    )
    assert spec.stop.num_env_steps == 1000
    assert spec.stop.training_return == 195
    assert (spec.env.id, spec.env.args) == ("CartPole-v1", {"sutton_barto_reward": True})
    assert (spec.scheduler.type, spec.scheduler.grace_env_steps) == ("asha", 50)
    assert cast("Any", spec.space["lr"]).values == (1e-3, 2e-3)
    assert spec.resources.max_concurrent == 1
    assert spec.hyperparams["grad_clip"] is None


@pytest.mark.parametrize(
    "path",
    ["num_samples", "stop", "stop.time_s", "env.args.x", "hyperparams.grad_clip", "hyperparams.tau", "space.gamma"],
)
def test_set_to_nothing_of_what_is_not_there_changes_nothing(path: str) -> None:
    assert load_spec(MINIMAL, [f"{path}="]) == load_spec(MINIMAL)


def test_an_empty_field_is_only_a_default_if_there_is_one() -> None:
    assert load_spec({**MINIMAL, "stop": None}) == load_spec(MINIMAL)
    assert "num_sample: there is no field 'num_sample' here." in errors(num_sample=None)


EMPTY = [
    "stop: {num_episodes: }",
    "stop:\n  training_return:\n  num_env_steps: 1000",
    "evaluation:\n  num_episodes:",
    "scheduler:\n  type:",
    "scheduler: {type: asha, reduction_factor: }",
    "search:\n  type:",
    "objective: {type: , cost: env_steps}",
    "resources: {num_gpus: }",
    "checkpoints: {every_iterations: null}",
    "confirm: {top: , seeds: 3}",
    "about: {title: , source: a book}",
    "env:\n  id: CartPole-v1\n  args:\n    # size: 3",
    "env: {id: CartPole-v1, frame_stack: , atari: {frame_skip: }}",
]


def without_null(data: Any) -> Any:
    if not isinstance(data, dict):
        return data
    return {key: without_null(value) for key, value in data.items() if value is not None}


@pytest.mark.parametrize("lines", EMPTY)
def test_an_empty_field_of_a_section_is_as_if_it_was_not_there(lines: str) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    data = {**MINIMAL, **parse_yaml(lines, "lines")}
    assert data != without_null(data)
    assert load_spec(data) == load_spec(without_null(data))
    assert list(jsonschema.Draft202012Validator(json_schema()).iter_errors(data)) == []


@pytest.mark.parametrize("path", ["stop.num_env_steps", "stop.num_iterations", "stop.time_s", "checkpoints.keep"])
def test_a_limit_that_is_null_is_refused_as_it_may_be_meant_as_none(path: str) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    section, _, name = path.partition(".")
    told = {section: {name: None}}
    with pytest.raises(SpecError, match=f"{path}: None is not allowed: it should be a "):
        load_spec({**MINIMAL, **told})
    assert list(jsonschema.Draft202012Validator(json_schema()).iter_errors({**MINIMAL, **told}))


def test_a_field_that_must_be_given_is_missing_if_it_is_empty() -> None:
    jsonschema = pytest.importorskip("jsonschema")
    assert "env.id: is missing: give a Gymnasium id such as CartPole-v1" in errors(env={"id": None, "frame_stack": 2})
    assert list(jsonschema.Draft202012Validator(json_schema()).iter_errors({**MINIMAL, "env": {"id": None}}))
    assert "stop.time: there is no field 'time' here" in errors(stop={"time": None})


def test_null_is_a_value_where_names_are_not_those_of_fields() -> None:
    given = {"env": {"id": "CartPole-v1", "args": {"size": None}}, "hyperparams": {"grad_clip": None}}
    spec = load_spec({**MINIMAL, **given, "space": {"lr": {"uniform": [0.1, 1]}}, "points": [{"lr": None}]})
    assert (spec.env.args, spec.hyperparams, spec.points) == ({"size": None}, {"grad_clip": None}, ({"lr": None},))
    assert "space.lr: null is one value" in errors(space={"lr": None})
    assert "hyperparams.lr: None is not allowed" in errors(hyperparams={"lr": None})


@pytest.mark.parametrize("section", Section.__subclasses__())
def test_a_field_that_may_be_null_is_null_if_it_is_left_out(section: type[Section]) -> None:
    """Else null, which is as if left out, would no longer be what it says."""
    for name, field in section.model_fields.items():
        if type(None) in get_args(field.annotation):
            assert not field.is_required(), name
            assert field.default is None, name


def test_set_to_nothing_takes_a_field_out_so_that_a_searched_one_can_be_fixed() -> None:
    assert "is fixed at 0.001 but also searched" in errors(
        space={"lr": {"uniform": [1e-4, 1e-2]}}, overrides=["hyperparams.lr=1e-3"]
    )
    spec = load_spec("cartpole-ppo", ["space.lr=", "hyperparams.lr=1e-3"])
    assert "lr" not in spec.space
    assert spec.hyperparams["lr"] == 1e-3


@pytest.mark.parametrize(
    ("override", "part"),
    [
        ("stop", "--set stop: this is not an assignment"),
        ("=3", "this is not an assignment"),
        ("stop..x=3", "this is not an assignment"),
        ("num_samples.x=3", "num_samples is 5, which has no fields"),
        ("stop.num_env_step=3", "stop.num_env_step: there is no field 'num_env_step' here."),
        ("stop.num_env_steps=-3", "stop.num_env_steps: -3 is not allowed"),
        ("space.lr={uniform: [1, 0]}", "space.lr.uniform: goes from 1.0 to 0.0"),
        ("space.lr={uniform: [", "--set space.lr={uniform: [, line 1"),
        ("stopp.x=1", "stopp: there is no field"),
        # There is nothing to take out.
        ("num_sample=", "num_sample: there is no field 'num_sample' here. Did you mean 'num_samples'? (from --set)"),
        ("stop.times_s=", "stop.times_s: there is no field 'times_s' here."),
        ("hyperparams.lrr=", "hyperparams.lrr: ppo has no hyperparameter 'lrr'."),
        ("space.lrr=", "space.lrr: "),
    ],
)
def test_bad_overrides(override: str, part: str) -> None:
    with pytest.raises(SpecError) as caught:
        load_spec("cartpole-ppo", [override])
    assert part in caught.value.message


@pytest.mark.parametrize("text", ["#ff0000", " # red", "#it's"])
def test_a_value_that_is_only_a_comment_is_refused_with_the_quotes_that_it_needs(text: str) -> None:
    with pytest.raises(SpecError) as caught:
        load_spec(MINIMAL, [f"env.args.color={text}"])
    written = text.strip()
    quoted = f"'{written}'".replace("t's", "t''s")
    assert caught.value.message == f"--set env.args.color={text}: {written} is a comment in YAML, so there is no value"
    assert f'put it in quotes, {quoted}, and on a command line in two pairs, "{quoted}".' in caught.value.hint
    assert load_spec(MINIMAL, [f"env.args.color={quoted}"]).env.args == {"color": written}


def test_a_value_that_ends_with_a_comment_is_not_cut() -> None:
    with pytest.raises(SpecError, match="what follows red is a comment in YAML, and no part of the value") as caught:
        load_spec(MINIMAL, ["env.args.color=red #2"])
    assert "put it in quotes, 'red #2'" in caught.value.hint
    kept = {"'red #2'": "red #2", "red#2": "red#2", '"red #2"': "red #2", "{a: 1} \n # 2": {"a": 1}}
    for text, value in kept.items():
        assert load_spec(MINIMAL, [f"env.args.color={text}"]).env.args["color"] == value


def test_null_and_nothing_are_no_comments() -> None:
    base = {**MINIMAL, "env": {"id": "CartPole-v1", "args": {"color": "red"}}}
    assert load_spec(base, ["env.args.color=null"]).env.args == {"color": None}
    assert load_spec(base, ["env.args.color="]).env.args == {}
    # What is read from a file may begin with one.
    assert load_spec(base, ["env.args.color=# of the cart\nblue"]).env.args == {"color": "blue"}


def test_a_problem_says_that_it_came_from_set() -> None:
    message = errors(num_samples=0, overrides=["seed=-1"])
    lines = message.splitlines()
    assert [("(from --set)" in line) for line in lines if "seed" in line or "num_samples" in line].count(True) == 1
    assert any(line.strip().startswith("seed:") and line.endswith("(from --set)") for line in lines)


def test_a_searched_length_of_training_is_named_anywhere_in_the_space() -> None:
    lengths: dict[str, Any] = {"stop.num_env_steps": {"choice": [50_000, 60_000]}}
    spec = load_spec(MINIMAL, ["space.stop.num_env_steps.choice=[3000, 4000]"])
    assert cast("Any", spec.space["stop.num_env_steps"]).values == (3000, 4000)
    assert spec.stop.num_env_steps == 4000
    space = {**lengths, "lr": {"uniform": [0.1, 0.2]}}
    spec = load_spec({**MINIMAL, "space": space}, ["space.lr.when.stop.num_env_steps=50000"])
    assert spec.space["lr"].when == {"stop.num_env_steps": 50_000}
    space["lr"] = {"uniform": [0.1, 0.2], "when": {"stop.num_env_steps": 50_000, "num_epochs": 2}}
    space["num_epochs"] = {"choice": [1, 2]}
    spec = load_spec({**MINIMAL, "space": space}, ["space.lr.when.stop.num_env_steps="])
    assert spec.space["lr"].when == {"num_epochs": 2}
    spec = load_spec(MINIMAL, ["space.stop.num_env_steps.grid=[10_000]", "space.stop.num_env_steps="])
    assert spec.space == {}
    message = errors(overrides=["space.stop.num_env_steps.randint=[5, 3]"])
    assert "space.stop.num_env_steps.randint: goes from 5 to 3" in message
    assert "(from --set)" in message


def test_a_cost_is_set_beside_the_name_that_a_file_may_give_the_score() -> None:
    spec = load_spec({**MINIMAL, "objective": "return"}, ["objective.cost=env_steps"])
    assert spec.objective == load_spec({**MINIMAL, "objective": ["return", "env_steps"]}).objective
    assert load_spec({**MINIMAL, "objective": {"type": "return"}}).objective.type == "final"
    assert "objective.type: ['x'] is not allowed" in errors(objective={"type": ["x"]})


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (["space.lr.loguniform=[1e-4, 1e-2]"], "and has uniform and loguniform"),
        ([f"space.lr.{name}=1" for name in "abcde"], "has a and b and c and d and more beside uniform"),
        (["space.lr={}"], "and has none"),
    ],
)
def test_a_domain_of_several_kinds_is_told_with_their_names(overrides: list[str], told: str) -> None:
    assert told in errors(space={"lr": {"uniform": [1e-4, 1e-2]}}, overrides=overrides)


def test_overrides_leave_the_mapping_they_were_given_alone() -> None:
    source = {**MINIMAL, "stop": {"num_env_steps": 10}}
    load_spec(source, ["stop.num_env_steps=20"])
    assert source["stop"] == {"num_env_steps": 10}


# -- JSON Schema


def test_the_schema_accepts_presets_and_refuses_what_is_wrong() -> None:
    jsonschema = pytest.importorskip("jsonschema")
    schema = json_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    good = {
        **MINIMAL,
        "hyperparams": {"lr": 0.1},
        "space": {"hidden_sizes": {"grid": [[32]]}, "gamma": {"uniform": [0, 1]}},
        "scheduler": "asha",
    }
    assert list(validator.iter_errors(good)) == []
    assert list(validator.iter_errors({**good, "env": {"id": "x", "args": {}}, "space": None})) == []
    bad = [
        {"algorithm": "ppo"},
        {**good, "x": 1},
        {**good, "hyperparams": {"dueling": True}},
        {**good, "space": {"tau": {"grid": [1]}}},
        {**good, "space": {"lr": {"grid": 1}}},
        {**good, "hyperparams": {"lr": 0}},
        {**good, "stop": {"x": 1}},
        {**good, "scheduler": {"type": "x"}},
    ]
    for wrong in bad:
        assert list(validator.iter_errors(wrong)), wrong


SPACE: dict[str, Any] = {"lr": {"uniform": [0.1, 0.2]}}


@pytest.mark.parametrize(
    ("data", "is_right"),
    [
        ({"prior": "acrobot", "search": "gp", "space": SPACE}, True),
        ({"prior": ["acrobot", "pendulum"], "search": "gp", "space": SPACE}, True),
        ({"prior": "", "search": "gp"}, False),
        ({"prior": 3, "search": "gp"}, False),
        ({"space": {"hidden_sizes": {"layers": {"number": 2, "sizes": [32, 64]}}}}, True),
        ({"space": {"hidden_sizes": {"layers": {"number": 2.0, "sizes": [32, 64]}}}}, True),
        ({"space": {"hidden_sizes": {"layers": {"number": [1, 2.0], "sizes": [32, 64]}}}}, True),
        ({"space": {"hidden_sizes": {"layers": {"number": "2", "sizes": [32, 64]}}}}, False),
        ({"space": {"hidden_sizes": {"layers": {"number": 2.5, "sizes": [32, 64]}}}}, False),
        ({"space": {"hidden_sizes": {"layers": {"number": True, "sizes": [32, 64]}}}}, False),
        ({"objective": {"type": "return", "cost": "env_steps"}}, True),
        ({"objective": {"type": "score", "cost": "env_steps"}}, False),
    ],
)
def test_the_schema_and_the_model_take_the_forms_that_a_field_may_have(data: dict[str, Any], *, is_right: bool) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    validator = jsonschema.Draft202012Validator(json_schema())
    whole = {**MINIMAL, "num_samples": 12, **data}
    assert validator.is_valid(whole) == is_right
    if is_right:
        load_spec(whole)
    else:
        errors(**data)


VALUES: list[Any] = [
    None, True, 0, 1, -1, 1.5, 5.0, 1e3, 1e6, "", "5", "x", "m:C", "asha", "relu", [], [1], [1.5], ["a"], [[1, 2]],
    [[1, 2, 3]], {}, {"a": 1}, {"grid": [8]}, {"grid": []},
]  # fmt: skip


def fields(model: type[BaseModel] = SweepSpec, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for name, field in model.model_fields.items():
        yield (*path, name)
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from fields(field.annotation, (*path, name))


CASES = [
    *(("ppo", path) for path in fields()),
    *(("ppo", ("space", "lr", kind)) for kind in DOMAIN_KINDS if kind not in ("grid", "choice")),
    *(
        (algorithm, ("hyperparams", name))
        for algorithm, model in HYPERPARAMS_BY_ALGORITHM.items()
        for name in model.model_fields
    ),
]


@pytest.mark.parametrize(
    ("algorithm", "path"), CASES, ids=lambda part: part if isinstance(part, str) else ".".join(part)
)
def test_the_schema_and_the_model_refuse_the_same_values_of_a_field(
    algorithm: Algorithm, path: tuple[str, ...]
) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    validator = jsonschema.Draft202012Validator(json_schema())
    for value in VALUES:
        data: dict[str, Any] = {"env": {"id": "x"}, "algorithm": algorithm}
        section = data
        for name in path[:-1]:
            section = section.setdefault(name, {})
        section[path[-1]] = value
        try:
            load_spec(data)
        except SpecError as error:
            # Told by the field itself, not by what goes together.
            words = ("it should be", "is not a number", "of the wrong type")
            told = [problem for problem in cast("Any", error).problems if any(word in problem.text for word in words)]
            assert not told or list(validator.iter_errors(data)), value
        else:
            assert list(validator.iter_errors(data)) == [], value


def test_the_schema_accepts_every_preset() -> None:
    import yaml

    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.Draft202012Validator.check_schema(json_schema())
    schema = jsonschema.Draft202012Validator(json_schema())
    for preset in list_presets():
        # A plain YAML 1.1 loader is what many editors use; it may take 1e-7 for a text, so numbers are read
        # our way.
        data = load_spec(preset.name).model_dump(mode="json")
        schema.validate(data)
        assert set(yaml.safe_load(preset.text)) <= set(data)


def test_the_schema_describes_every_field() -> None:
    schema = json_schema()
    for name in (
        "StopSpec",
        "SchedulerSpec",
        "EvaluationSpec",
        "CheckpointSpec",
        "ResourcesSpec",
        "PPOHyperparams",
    ):
        assert all(field.get("description") for field in schema["$defs"][name]["properties"].values()), name
    assert all(field.get("description") for field in schema["properties"].values())

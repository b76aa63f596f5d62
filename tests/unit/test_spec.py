"""Sweep files: what is read from them, and that everything wrong with them is told at once."""

import json
import math
import re
from pathlib import Path
from typing import Any, cast

import pytest
from spec_errors import MINIMAL, errors, write

from policies.activations import ACTIVATIONS
from policies.errors import SpecError
from tune_jobs.spec.domains import Grid
from tune_jobs.spec.file import find_preset, list_presets, load_spec, read_preset
from tune_jobs.spec.ranges import Uniform
from tune_jobs.spec.sweep_spec import SweepSpec, check_sweep_name

# -- what is read


def test_the_smallest_sweep_has_finite_caps() -> None:
    spec = load_spec(MINIMAL)
    assert spec.env.id == "CartPole-v1"
    assert spec.stop.num_env_steps == 200_000
    assert spec.stop.num_iterations == 100_000
    assert math.isfinite(spec.stop.time_s)
    assert spec.cpus_per_trial == 1


def test_numbers_as_people_write_them(tmp_path: Path) -> None:
    spec = load_spec(
        write(
            tmp_path,
            """
env: CartPole-v1
algorithm: ppo
hyperparams: {lr: 3e-4, hidden_sizes: [512, 256, 64], grad_clip: null}
space: {gamma: {uniform: [9E-1, 0.99]}, clip_param: {grid: [1e-1, .2]}}
stop: {num_env_steps: 5e4, time_s: 1e+2}
""",
        )
    )
    assert spec.hyperparams == {"lr": 3e-4, "hidden_sizes": [512, 256, 64], "grad_clip": None}
    assert cast("Any", spec.space["gamma"]).bounds == (0.9, 0.99)
    assert cast("Any", spec.space["clip_param"]).values == (0.1, 0.2)
    assert (spec.stop.num_env_steps, spec.stop.time_s) == (50_000, 100.0)


def test_zero_and_null_are_values_of_their_own() -> None:
    spec = load_spec(
        {
            **MINIMAL,
            "hyperparams": {"entropy_coeff": 0},
            "stop": {"training_return": 0},
            "checkpoints": {"keep": 0},
            "max_retries": 0,
        }
    )
    assert spec.stop.training_return == 0.0
    assert spec.stop.evaluation_return is None
    assert (spec.checkpoints.keep, spec.max_retries, spec.hyperparams["entropy_coeff"]) == (0, 0, 0)


def test_sections_can_be_short_empty_or_full(tmp_path: Path) -> None:
    spec = load_spec(
        write(
            tmp_path,
            "env: {id: CartPole-v1, args: {sutton_barto_reward: true}}\nalgorithm: ppo\nspace:\nscheduler: asha\n",
        )
    )
    assert spec.env.args == {"sutton_barto_reward": True}
    assert spec.space == {}
    assert spec.scheduler.type == "asha"
    assert spec.grace_env_steps == 10_000


def test_a_resolved_spec_round_trips_through_json() -> None:
    spec = load_spec(
        "cartpole-ppo", ["seeds_per_point=2", "space.gamma={loguniform: [0.9, 0.99]}", "hyperparams.gamma="]
    )
    dumped = json.loads(json.dumps(spec.model_dump(mode="json")))
    assert SweepSpec.model_validate(dumped) == spec
    assert list(dumped["space"]) == ["hidden_sizes", "activation", "lr", "gamma"]
    assert load_spec(dumped) == spec


def test_domains_can_be_given_as_objects() -> None:
    spec = load_spec({**MINIMAL, "space": {"lr": Uniform(uniform=(1e-4, 1e-3)), "activation": Grid(grid=("relu",))}})
    assert spec.space["lr"] == Uniform(uniform=(1e-4, 1e-3))


def test_a_spec_cannot_be_changed() -> None:
    with pytest.raises(Exception, match="frozen"):
        load_spec(MINIMAL).num_samples = 3  # type: ignore[misc]


# -- presets


def test_every_preset_loads_says_what_it_is_and_has_no_name() -> None:
    presets = list_presets()
    assert {"cartpole-ppo", "cartpole-random"} <= {preset.name for preset in presets}
    for preset in presets:
        assert load_spec(preset.name).name is None
        for label in ("title", "source", "shows", "expected", "env_steps", "time"):
            assert getattr(preset, label), f"{preset.name} lacks {label}"
        assert not preset.title.startswith(("Source:", "Shows:")), preset.name
        assert preset.time.endswith(" on 2 cores"), preset.name
        assert re.match(r"-?[\d.,]+ \(", preset.expected), f"{preset.name}: {preset.expected!r}"


def test_a_preset_is_what_its_about_says() -> None:
    text = (
        "about:\n  title: 'Plain title: with a colon'\n  source: 'a book: chapter 2'\n  shows: what happens\n"
        "  expected: 195 (x)\n  env_steps: 3,000\n  time: 2 s on 2 cores\n  description: >-\n    Free words,\n"
        "    Time: more of them\nenv: CartPole-v1\n# no more\n"
    )
    preset = read_preset("mine", text)
    assert preset == (
        "mine", "Plain title: with a colon", "a book: chapter 2", "what happens", "195 (x)", "3,000",
        "2 s on 2 cores", "Free words, Time: more of them", text,
    )  # fmt: skip
    assert read_preset("bare", "env: x\n")[1:-1] == ("",) * 7


def test_any_sweep_may_say_what_it_is_about(tmp_path: Path) -> None:
    spec = load_spec(write(tmp_path, "about: Which one?\nenv: CartPole-v1\nalgorithm: ppo\n"), ["about.expected=high"])
    assert (spec.about.title, spec.about.expected, spec.about.description) == ("Which one?", "high", "")
    assert spec.model_dump(mode="json")["about"] == {"title": "Which one?", "expected": "high"}
    assert SweepSpec.model_validate(json.loads(spec.model_dump_json())) == spec
    assert SweepSpec(**MINIMAL, about="Which one?").about.title == "Which one?"
    assert load_spec("cartpole-ppo").about.title == find_preset("cartpole-ppo").title


def test_a_sweep_that_says_nothing_of_itself_is_written_as_if_there_were_no_such_field() -> None:
    # Fields that are null are what older versions may not know.
    assert load_spec(MINIMAL).model_dump(mode="json")["about"] is None
    assert load_spec({**MINIMAL, "about": {"title": ""}}).model_dump(mode="json")["about"] is None


@pytest.mark.parametrize(
    ("about", "part"),
    [
        (3, "about: 3 is not allowed: give a text, or a mapping"),
        ({"expected": 195}, "about.expected: 195 is not allowed: it should be a text"),
        ({"titel": "x"}, "about.titel: there is no field 'titel' here. Did you mean 'title'?"),
    ],
)
def test_what_a_sweep_says_of_itself_is_text(about: Any, part: str) -> None:
    assert part in errors(about=about)


def test_the_words_of_about_are_not_proposed_as_settings() -> None:
    assert "Did you mean 'num_env_steps'?" in errors(stop={"env_steps": 5})
    assert "Did you mean 'time_s'?" in errors(stop={"time": 5})


def test_the_cartpole_preset_is_the_tutorials_sweep() -> None:
    spec = load_spec("cartpole-ppo")
    assert spec.env.id == "CartPole-v0"
    assert cast("Any", spec.space["hidden_sizes"]).values == ([32], [64])
    assert cast("Any", spec.space["activation"]).values == ("linear", "relu")
    assert cast("Any", spec.space["lr"]).bounds == (1e-7, 1e-2)
    assert spec.num_samples == 5
    assert spec.stop.training_return == 195


def test_an_unknown_source_names_the_nearest_preset(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=r"'cartpol-ppo'.*Did you mean 'cartpole-ppo'"):
        load_spec("cartpol-ppo")
    with pytest.raises(SpecError, match="is a folder"):
        load_spec(tmp_path)
    with pytest.raises(SpecError, match="Did you mean 'cartpole-ppo'"):
        find_preset("cartpole")


def test_a_file_wins_over_a_preset_of_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("cartpole-ppo").write_text("env: Acrobot-v1\nalgorithm: dqn\n")
    assert load_spec("cartpole-ppo").env.id == "Acrobot-v1"


# -- what is wrong


@pytest.mark.parametrize(
    ("fields", "parts"),
    [
        ({"enviroment": "x"}, ["enviroment: there is no field", "Did you mean 'env'?"]),
        ({"num_sample": 3}, ["num_sample", "Did you mean 'num_samples'?"]),
        ({"stop": {"num_env_step": 5}}, ["stop.num_env_step", "Did you mean 'num_env_steps'?"]),
        ({"stop": {"episode_reward_mean": 195}}, ["stop.episode_reward_mean", "Known here: training_return"]),
        ({"num_env_steps": 5}, ["num_env_steps", "Did you mean stop.num_env_steps?"]),
        ({"lr": 0.1}, ["lr", "hyperparams.lr or space.lr"]),
        ({"num_samples": "many"}, ["num_samples", "'many' is not a number"]),
        ({"num_samples": True}, ["num_samples", "true is not a number"]),
        ({"num_samples": 1.5}, ["num_samples", "1.5"]),
        ({"num_samples": 0}, ["num_samples", "0 is not allowed"]),
        ({"seed": -1}, ["seed", "-1 is not allowed"]),
        ({"stop": {"time_s": float("inf")}}, ["stop.time_s", "finite"]),
        ({"stop": {"num_env_steps": None}}, ["stop.num_env_steps", "None"]),
        ({"stop": [1]}, ["stop", "[1]"]),
        ({"algorithm": "pppo"}, ["algorithm", "'pppo'", "Did you mean 'ppo'?"]),
        ({"scheduler": "ahsa"}, ["scheduler.type", "'ahsa'", "Did you mean 'asha'?"]),
        (
            {"scheduler": {"type": "asha", "grace_env_steps": 200_000}},
            ["scheduler.grace_env_steps", "200000"],
        ),
        ({"resources": {"num_cpus": 1, "num_env_runners": 2}}, ["resources.num_cpus: 1 is fewer than the 3"]),
        ({"resources": {"num_gpus": 1.5}}, ["resources.num_gpus: 1.5", "one GPU at most"]),
        ({"resources": {"num_gpus": 2}}, ["resources.num_gpus: 2"]),
        ({"name": "../x"}, ["name: '../x' is not allowed"]),
        ({"name": ".x"}, ["name: '.x' is not allowed"]),
        ({"name": "x\n"}, ["name: 'x\\n' is not allowed"]),
        ({"env": 5}, ["env"]),
        ({"env": {"args": {}}}, ["env.id: is missing"]),
        ({"hyperparams": {"lr": 0}}, ["hyperparams.lr: 0 is not allowed: it should be greater than 0"]),
        ({"hyperparams": {"lr": -1e-3}}, ["hyperparams.lr: -0.001 is not allowed"]),
        ({"hyperparams": {"lr": "1e-3"}}, ["hyperparams.lr: '1e-3' is of the wrong type"]),
        ({"hyperparams": {"num_epochs": True}}, ["hyperparams.num_epochs: true is of the wrong type"]),
        ({"hyperparams": {"vf_share_layers": 1}}, ["hyperparams.vf_share_layers: 1 is of the wrong type"]),
        # Also where it doesn't go with the others, which is looked at in each point.
        ({"hyperparams": {"lr_final": "5"}}, ["hyperparams.lr_final: '5' is of the wrong type"]),
        ({"hyperparams": {"train_batch_size": True}}, ["hyperparams.train_batch_size: true is of the wrong type"]),
        ({"space": {"lr_decay_steps": {"grid": ["5"]}}}, ["space.lr_decay_steps.grid[0]: '5' is of the wrong type"]),
        ({"hyperparams": {"hidden_sizes": [32, 0]}}, ["hyperparams.hidden_sizes[1]: 0 is not allowed"]),
        ({"hyperparams": {"hidden_sizes": []}}, ["hyperparams.hidden_sizes"]),
        (
            {"hyperparams": {"activation": "rellu"}},
            ["hyperparams.activation: 'rellu'", "Did you mean 'relu'?"],
        ),
        (
            {"hyperparams": {"learning_rate": 0.1}},
            ["hyperparams.learning_rate: ppo has no", "Did you mean 'lr'?"],
        ),
        ({"hyperparams": {"double_q": True}}, ["ppo has no hyperparameter 'double_q'", "dqn has it"]),
        ({"hyperparams": {"epochs": 3}}, ["hyperparams.epochs: ppo has no", "Did you mean 'num_epochs'?"]),
        (
            {"hyperparams": {"xyz": 3}},
            ["hyperparams.xyz: ppo has no", "It has activation, clip_decay_steps, clip_param"],
        ),
        (
            {"space": {"gama": {"grid": [0.9]}}},
            ["space.gama: ppo has no hyperparameter", "Did you mean 'gamma'?"],
        ),
        ({"space": {"gama": {"grid": []}}}, ["space.gama.grid: is empty", "Did you mean 'gamma'?"]),
        ({"space": {"lr": {"grid": []}}}, ["space.lr.grid: is empty"]),
        ({"space": {"lr": {"unifrom": [1, 2]}}}, ["space.lr: there is no domain 'unifrom'", "'uniform'"]),
        ({"space": {"lr": {"uniform": [0, 0.01]}}}, ["space.lr.uniform[0]: 0.0 is not allowed"]),
        ({"space": {"lr": {"loguniform": [0, 0.01]}}}, ["space.lr.loguniform: starts at 0.0"]),
        ({"space": {"gamma": {"uniform": [0.9, 1.1]}}}, ["space.gamma.uniform[1]: 1.1 is not allowed"]),
        ({"space": {"lr": 0.01}}, ["space.lr: 0.01 is one value: fix it under hyperparams"]),
        (
            {"space": {"activation": {"grid": ["relu", "swish"]}}},
            ["space.activation.grid[1]: 'swish'", *ACTIVATIONS],
        ),
        (
            {"space": {"num_epochs": {"uniform": [1, 4]}}},
            ["space.num_epochs.uniform: can give", "use randint"],
        ),
        ({"space": {"num_epochs": {"quniform": [1, 4, 0.5]}}}, ["space.num_epochs.quniform: can give"]),
        ({"space": {"num_epochs": {"randint": [0, 4]}}}, ["space.num_epochs.randint[0]: 0 is not allowed"]),
        ({"space": {"activation": {"randint": [0, 4]}}}, ["space.activation.randint[0]: 0 is not allowed"]),
        (
            {"space": {"vf_share_layers": {"randint": [0, 2]}}},
            ["space.vf_share_layers.randint[0]: 0 is of the"],
        ),
        (
            {"space": {"lr": {"grid": [1e-3]}}, "hyperparams": {"lr": 0.1}},
            ["hyperparams.lr: is fixed at 0.1 but also searched in space.lr"],
        ),
        ({"env": "x", "hyperparams": {"lr": object()}}, ["JSON"]),
    ],
)
def test_what_is_wrong_is_told_with_its_place_and_value(fields: dict[str, Any], parts: list[str]) -> None:
    message = errors(**fields)
    for part in parts:
        assert part in message


def test_every_problem_is_told_at_once() -> None:
    message = errors(
        base={},
        algorithm="dqn",
        num_samples="x",
        hyperparams={"num_epochs": 3, "lr": -1},
        space={"gamma": {"grid": []}, "taau": {"uniform": [0, 1]}, "tau": {"uniform": [0.5, 2]}},
    )
    assert message.startswith("sweep: 7 problems:\n  ")
    for part in (
        "env: is missing",
        "num_samples: 'x'",
        "hyperparams.num_epochs",
        "hyperparams.lr",
        "space.gamma.grid",
        "space.taau",
        "space.tau.uniform[1]",
    ):
        assert part in message


def test_whole_values_of_a_quantised_float_range_are_accepted() -> None:
    assert (
        cast("Any", load_spec({**MINIMAL, "space": {"num_epochs": {"quniform": [2, 8, 2]}}}).space["num_epochs"]).q == 2
    )


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("env: a\nenv: b\n", "sweep.yaml, line 2, column 1: the key 'env' occurs twice"),
        (
            "env: a\nspace:\n  lr: {grid: [1]}\n  lr: {grid: [2]}\n",
            "sweep.yaml, line 4, column 3: the key 'lr'",
        ),
        ("env: [a\n", "sweep.yaml, line 2"),
        ("", "sweep.yaml: is empty"),
        ("- a\n", "sweep.yaml: holds a list"),
        (
            "env: !!python/object/apply:os.system [ls]\n",
            "sweep.yaml, line 1, column 6: the tag !!python/object/apply:os.system",
        ),
        ("env: x\nalgorithm: ppo\nhyperparams: {lr: &a [*a]}\n", "line 3, column 19: contains itself"),
    ],
)
def test_bad_yaml_is_told_with_its_line(tmp_path: Path, text: str, part: str) -> None:
    with pytest.raises(SpecError) as caught:
        load_spec(write(tmp_path, text))
    assert part in caught.value.message


def test_a_file_that_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "sweep.yaml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SpecError, match="can't be read"):
        load_spec(path)
    path.write_bytes("env: CartPole-v1\nname: caf\u00e9\n".encode("latin-1"))
    with pytest.raises(SpecError, match="can't be read: line 2 is not UTF-8, from byte 0xe9 on") as caught:
        load_spec(path)
    assert "UTF-8" in caught.value.hint


@pytest.mark.parametrize(("penalty", "limit"), [(1e39, "at most"), (-1e300, "at least -")])
def test_a_failure_penalty_that_is_infinite_to_learners_is_refused(penalty: float, limit: str) -> None:
    told = errors(env={"id": "CartPole-v1", "failure_penalty": penalty})
    assert f"env.failure_penalty: {penalty!r} is not allowed: it should be {limit}" in told


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "a b", "-x", "x" * 101, "é", "x\n"])
def test_bad_sweep_names(name: str) -> None:
    with pytest.raises(SpecError, match="sweep name"):
        check_sweep_name(name)


@pytest.mark.parametrize("name", ["a", "cartpole-ppo_2.1", "0", "x" * 100])
def test_good_sweep_names(name: str) -> None:
    assert check_sweep_name(name) == name
    assert load_spec({**MINIMAL, "name": name}).name == name


@pytest.mark.parametrize("name", ["random", "constant"])
def test_a_new_sweep_is_not_called_as_a_baseline_is(name: str) -> None:
    with pytest.raises(
        SpecError, match=f"The sweep name '{name}' is not allowed: .* it is the {name} policy"
    ) as caught:
        check_sweep_name(name)
    assert f"'{name}-sweep'" in caught.value.hint
    # Sweeps of former versions may be, and their files are still read.
    assert load_spec({**MINIMAL, "name": name}).name == name

"""Values of a space that are written in another form than the domain's, and what messages say of them."""

from typing import Any

import pytest
from spec_errors import MINIMAL, errors

from policies.errors import SpecError
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.conditions import Conditions
from tune_jobs.spec.draws import draw_points
from tune_jobs.spec.file import load_spec

DQN = {**MINIMAL, "algorithm": "dqn", "num_samples": 40}


def acting_with(domain: dict[str, Any], given: Any, *, name: str, **fields: Any) -> set[str]:
    """The values of a hyperparameter with which one acts that needs it, of those that are drawn."""
    space = {name: domain, "lr": {"loguniform": [1e-4, 1e-2], "when": {name: given}}}
    spec = load_spec({**DQN, "space": space, **fields})
    points = draw_points(spec.space, spec.num_samples, spec.seed)
    return {repr(point[name]) for point in points if "lr" in point}


@pytest.mark.parametrize(
    ("name", "domain", "given", "expected"),
    [
        ("tau", {"quniform": [0.1, 1.0, 0.1]}, 0.1 + 0.2, {"0.3"}),
        ("tau", {"quniform": [0.1, 1.0, 0.1]}, [0.3, 0.6 + 0.1], {"0.3", "0.7"}),
        ("stop.num_env_steps", {"choice": [2e4, 5e4]}, 2e4, {"20000"}),
        ("stop.num_env_steps", {"choice": [2e4, 5e4]}, 20_000, {"20000"}),
        ("train_batch_size", {"choice": [1e3, 2e3]}, 1000, {"1000.0"}),
        ("train_batch_size", {"power_of_two": [16, 64]}, 32.0, {"32"}),
        ("n_step", {"choice": [1, 3]}, 3.0, {"3"}),
        ("n_step", {"choice": [1, 3]}, [3.0, 1], {"1", "3"}),
        ("hidden_sizes", {"choice": [[64], [128]]}, 64, {"[64]"}),
        ("hidden_sizes", {"choice": [[64], [128], [64, 128]]}, [64, 128], {"[64, 128]"}),
        ("hidden_sizes", {"choice": [[64], [128], [32]]}, [64, 128], {"[64]", "[128]"}),
        ("hidden_sizes", {"choice": [64, 128]}, [[64.0]], {"64"}),
    ],
)
def test_a_condition_holds_with_its_value_in_whatever_form(
    name: str, domain: dict[str, Any], given: Any, expected: set[str]
) -> None:
    assert acting_with(domain, given, name=name) == expected


def test_true_is_not_1_and_a_value_outside_of_powers_is_not_the_nearest_one() -> None:
    with_flag = {"dueling": {"choice": [True, False]}, "lr": {"uniform": [0.1, 0.2], "when": {"dueling": 1}}}
    assert "space.lr.when.dueling: 1 is no value that dueling can have" in errors(base=DQN, space=with_flag)
    space = {"n_step": {"power_of_two": [1, 8]}, "lr": {"uniform": [0.1, 0.2], "when": {"n_step": 4}}}
    conditions = Conditions(load_spec({**DQN, "space": space}).space)
    assert ["lr" in conditions.acting({"n_step": value, "lr": 0.1}) for value in (4, 4.0, 5, 3, 0)] == [
        True, True, False, False, False,
    ]  # fmt: skip


def test_conditions_in_two_forms_do_not_contradict_each_other() -> None:
    space = {
        "hidden_sizes": {"choice": [[64], [128]]},
        "double_q": {"choice": [True, False], "when": {"hidden_sizes": 64}},
        "lr": {"uniform": [0.1, 0.2], "when": {"hidden_sizes": [[64]], "double_q": True}},
    }
    points = draw_points(load_spec({**DQN, "space": space}).space, 40, 0)
    assert any("lr" in point for point in points)
    space["lr"] = {"uniform": [0.1, 0.2], "when": {"hidden_sizes": [[128]], "double_q": True}}
    assert "space.lr.when: can never hold" in errors(base=DQN, space=space)


# -- messages


@pytest.mark.parametrize("kind", [{"randint": [1, 6]}, {"lograndint": [1, 6]}, {"qrandint": [1, 6, 1]}])
def test_the_upper_end_that_is_left_out_is_told(kind: dict[str, Any]) -> None:
    def told(value: int) -> str:
        return errors(base=DQN, space={"n_step": kind, "lr": {"uniform": [0.1, 0.2], "when": {"n_step": value}}})

    assert "6 is no value that n_step can have" in told(6)
    assert told(6).splitlines()[0].endswith("whose upper end is left out")
    assert "left out" not in told(7)


def test_the_upper_end_that_is_no_multiple_of_the_step_is_not_left_out() -> None:
    lr = {"uniform": [0.1, 0.2], "when": {"n_step": 7}}
    assert "left out" not in errors(base=DQN, space={"n_step": {"qrandint": [2, 7, 2]}, "lr": lr})


def test_words_of_yaml_are_shown_as_a_file_has_them() -> None:
    flag = {"choice": [True, False]}
    lr = {"uniform": [0.1, 0.2]}
    message = errors(base=DQN, space={"dueling": flag, "lr": {**lr, "when": {"dueling": None}}})
    assert "null is no value that dueling can have: it is one of true, false." in message
    assert "is fixed at true under" in errors(
        base=DQN, hyperparams={"dueling": True}, space={"lr": {**lr, "when": {"dueling": True}}}
    )
    assert "always true, its default" in errors(base=DQN, space={"lr": {**lr, "when": {"dueling": True}}})
    clip = {"choice": [None, 1.0]}
    both = {
        "grad_clip": clip,
        "dueling": {**flag, "when": {"grad_clip": 1.0}},
        "lr": {**lr, "when": {"grad_clip": [None], "dueling": True}},
    }
    assert "lr only with grad_clip null" in errors(base=DQN, space=both)
    assert "space.lr.grid: lists null twice" in errors(base=DQN, space={"lr": {"grid": [None, None]}})
    assert "1 is of the wrong type: write true if" in errors(base=DQN, space={"dueling": {"grid": [1]}})


@pytest.mark.parametrize(
    ("sizes", "told"),
    [
        ([[32], [64]], "[32] is not allowed: each size is a whole number"),
        ([32, 64.5], "64.5 is not allowed: each size"),
        ([True], "true is not allowed: each size"),
        ([0], "0 is not allowed: each size"),
        ({"randint": [0, 5]}, "0 is not allowed: it should be"),
    ],
)
@pytest.mark.parametrize("number", [1, 2, [1, 3]])
def test_a_wrong_size_of_layers_is_told_once_as_the_file_has_it(sizes: Any, told: str, number: Any) -> None:
    message = errors(space={"hidden_sizes": {"layers": {"number": number, "sizes": sizes}}})
    assert message.startswith(f"sweep: space.hidden_sizes.layers.sizes: {told}")
    assert len(message.splitlines()) == 1


def test_a_number_of_layers_may_be_a_whole_float_and_what_it_should_be_is_told() -> None:
    space: dict[str, Any] = {"hidden_sizes": {"layers": {"number": 2.0, "sizes": [32]}}}
    assert draw_points(load_spec({**DQN, "space": space}).space, 1, 0) == [{"hidden_sizes": [32, 32]}]
    space["hidden_sizes"]["layers"]["number"] = 2.5
    assert "layers.number: 2.5 is not allowed: it should be a whole number, or [fewest, most]" in errors(space=space)


def test_more_than_a_million_trials_are_not_counted_one_by_one() -> None:
    grids: dict[str, Any] = {name: {"grid": [k / 1000 for k in range(1, 102)]} for name in ("lr", "tau", "gamma")}
    grids["dueling"] = {"grid": [True, False]}
    grids["tau"]["when"] = grids["gamma"]["when"] = {"dueling": True}
    grids["prioritized_alpha"] = {"grid": [0.1, 0.2, 0.3], "when": {"tau": 0.001, "gamma": 0.001, "lr": 0.001}}
    spec = load_spec({**MINIMAL, "algorithm": "dqn", "hyperparams": {"replay": "prioritized"}, "space": grids})
    with pytest.raises(SpecError, match="has more than 1,000,000 trials; at most 100,000"):
        make_plan(spec, Machine(2))

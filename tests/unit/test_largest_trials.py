"""The largest trials that points may have which are not known before a sweep starts."""

from typing import Any

import pytest
from spec_errors import MINIMAL

from tune_jobs.plan.machine import Machine
from tune_jobs.plan.points import point_hyperparams
from tune_jobs.plan.sweep_plan import SweepPlan, make_plan
from tune_jobs.search.points import largest_hyperparams
from tune_jobs.spec.file import load_spec

DQN: dict[str, Any] = {**MINIMAL, "algorithm": "dqn", "num_samples": 12, "stop": {"num_env_steps": 60_000}}
PRIORITIZED: dict[str, Any] = {"hyperparams": {"replay": "prioritized"}}


def plan(**fields: Any) -> SweepPlan:
    return make_plan(load_spec({**DQN, **fields}), Machine(2))


def largest(point: dict[str, Any], **fields: Any) -> list[Any]:
    spec = load_spec({**DQN, "search": "auto", **fields})
    return largest_hyperparams(spec, [point_hyperparams(spec, point, 0)])


@pytest.mark.parametrize("method", [{"search": "auto"}, {"scheduler": "pbt"}])
@pytest.mark.parametrize(
    "domain",
    [{"lograndint": [1000, 50_000]}, {"quniform": [1000, 50_000, 1000]}, {"choice": [1e3, 5e4]}],
    ids=lambda domain: next(iter(domain)),
)
def test_the_ends_of_whole_hyperparameters_are_whole_numbers(method: dict[str, Any], domain: dict[str, Any]) -> None:
    fields = {**PRIORITIZED, **method}
    assert plan(**fields, space={"replay_capacity": domain}).num_points == 12
    made = plan(**fields, space={"env_steps_per_iteration": domain})
    assert type(made.max_env_steps_per_trial) is int


def test_the_value_where_a_condition_does_not_hold_is_a_whole_number_too() -> None:
    capacity = {"choice": [2e3, 4e3], "when": {"replay": "prioritized"}}
    space = {"replay": {"choice": ["uniform", "prioritized"]}, "replay_capacity": capacity}
    found = largest({"replay": "uniform"}, hyperparams={"replay_capacity": 1e3}, space=space)
    assert {(type(each.replay_capacity), each.replay_capacity) for each in found} == {
        (int, 1000), (int, 2000), (int, 4000),
    }  # fmt: skip


@pytest.mark.parametrize("first", ["none", "uniform"])
def test_the_largest_trial_has_the_largest_replay_memory_whatever_the_first_point_has(first: str) -> None:
    space = {"replay": {"choice": ["uniform", "none"]}, "replay_capacity": {"choice": [50_000, 100_000_000]}}
    found = largest({"replay": first, "replay_capacity": 50_000}, space=space)
    assert {each.replay for each in found} == {"uniform"}
    bound = {"choice": ["none"], "when": {"dueling": True}}
    space = {"dueling": {"choice": [True, False]}, "replay": bound}
    (found,) = largest({"dueling": True, "replay": "none"}, **PRIORITIZED, space=space)
    assert found.replay == "prioritized"


def test_the_most_env_steps_count_the_greatest_train_freq_and_memory_the_greatest_minibatch() -> None:
    made = plan(search="auto", space={"train_freq": {"choice": [4, 2000]}})
    assert made.max_env_steps_per_trial >= 60_000 + 1000 + 1999 - 2
    spec = load_spec(
        {**MINIMAL, "search": "auto", "num_samples": 12, "space": {"minibatch_size": {"randint": [64, 129]}}}
    )
    (found,) = largest_hyperparams(spec, [point_hyperparams(spec, {"minibatch_size": 64}, 0)])
    assert getattr(found, "minibatch_size", None) == 128

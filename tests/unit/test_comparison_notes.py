"""The plan says where evaluations are too rare for the scheduler, which compares trials there alone."""

from typing import Any

import pytest

from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.file import load_spec

LR = {"lr": {"loguniform": [1e-4, 1e-2]}}


def notes(scheduler: Any, every: int, **fields: Any) -> list[str]:
    """What the plan says of a sweep of 60,000 env steps a trial, in iterations of 1,000."""
    sweep = {
        "env": "CartPole-v1",
        "algorithm": "ppo",
        "space": LR,
        "num_samples": 8,
        "hyperparams": {"train_batch_size": 1000, "minibatch_size": 100},
        "stop": {"num_env_steps": 60_000},
        "scheduler": scheduler,
        "evaluation": {"every_iterations": every},
    }
    made = make_plan(load_spec({**sweep, **fields}), Machine(2))
    return [note for note in made.notes if "apart" in note]


# Without a number the rungs of 60,000 env steps are at 3,000, 9,000 and 27,000; populations are compared each 6,000.
@pytest.mark.parametrize(
    ("scheduler", "every", "wanted", "made"),
    [
        ("asha", 30, "3 times", "30,000 env steps apart: 1 time, first after 30,000."),
        ("asha", 60, "3 times", "60,000 env steps apart: never."),
        ("asha", 1_000, "3 times", "1,000,000 env steps apart: never."),
        (
            {"type": "asha", "grace_env_steps": 3_000}, 10, "3 times",
            "10,000 env steps apart: 2 times, first after 10,000.",
        ),
        ({"type": "asha", "reduction_factor": 20.0}, 60, "at least once", "60,000 env steps apart: never."),
        ("hyperband", 60, "3 times", "60,000 env steps apart: never."),
        ("median", 60, "at least once", "60,000 env steps apart: never."),
        ("pbt", 20, "9 times", "20,000 env steps apart: 2 times, first after 20,000."),
        ("pb2", 60, "9 times", "60,000 env steps apart: never."),
        (
            {"type": "pbt", "perturb_every_env_steps": 8_000}, 10, "7 times",
            "10,000 env steps apart: 5 times, first after 10,000.",
        ),
    ],
)  # fmt: skip
def test_rare_evaluations_are_told(scheduler: Any, every: int, wanted: str, made: str) -> None:
    (note,) = notes(scheduler, every)
    kind = scheduler if isinstance(scheduler, str) else scheduler["type"]
    assert note == (
        f"{kind} is to compare each trial {wanted} before its end at 60,000 env steps, but evaluations, where it does "
        f"so, are {made} Lower evaluation.every_iterations, {every}."
    )


@pytest.mark.parametrize(
    ("scheduler", "every"),
    [
        ("none", 60), ("asha", 3), ("asha", 10), ({"type": "asha", "grace_env_steps": 10_000}, 10), ("hyperband", 10),
        ("median", 30), ("pbt", 6), ("pbt", 10), ({"type": "pbt", "perturb_every_env_steps": 30_000}, 20),
        ({"type": "asha", "reduction_factor": 1e308}, 10),
    ],
)  # fmt: skip
def test_evaluations_that_are_close_enough_are_not_mentioned(scheduler: Any, every: int) -> None:
    assert notes(scheduler, every) == []


def test_the_batch_is_named_where_each_iteration_is_evaluated() -> None:
    (note,) = notes("asha", 1, hyperparams={"train_batch_size": 30_000, "minibatch_size": 100})
    assert note.endswith(
        "30,000 env steps apart: 1 time, first after 30,000. Lower train_batch_size, the env steps of an iteration."
    )
    (note,) = notes("asha", 1, algorithm="dqn", hyperparams={"env_steps_per_iteration": 30_000})
    assert note.endswith("Lower env_steps_per_iteration, the env steps of an iteration.")


def test_the_trials_that_are_compared_least_are_told() -> None:
    batches = {**LR, "train_batch_size": {"grid": [1_000, 2_000, 6_000]}}
    (note,) = notes("asha", 5, space=batches, hyperparams={"minibatch_size": 100})
    assert "30,000 env steps apart: 1 time" in note
    lengths = {**LR, "stop.num_env_steps": {"grid": [20_000, 60_000]}}
    (note,) = notes({"type": "asha", "grace_env_steps": 3_000}, 20, space=lengths, stop={"num_iterations": 1_000})
    assert "2 times before its end at 20,000 env steps" in note
    assert "20,000 env steps apart: never" in note
    batches = {**LR, "train_batch_size": {"grid": [10_000, 40_000, 20_000]}}
    (note,) = notes("asha", 6, space=batches, hyperparams={"minibatch_size": 100})
    assert "240,000 env steps apart: never" in note


def test_what_a_model_chooses_is_told_by_what_it_may_choose() -> None:
    batches = {**LR, "train_batch_size": {"choice": [1_000, 30_000]}}
    (note,) = notes("asha", 1, space=batches, hyperparams={"minibatch_size": 100}, num_samples=12, search="gp")
    assert "30,000 env steps apart: 1 time" in note


def refills(scheduler: Any, **hyperparams: Any) -> list[str]:
    """What the plan says of a sweep of DQN, whose populations are compared each 6,000 env steps."""
    sweep = {
        "env": "CartPole-v1", "algorithm": "dqn", "space": LR, "num_samples": 8, "hyperparams": hyperparams,
        "stop": {"num_env_steps": 60_000}, "scheduler": scheduler,
    }  # fmt: skip
    return [note for note in make_plan(load_spec(sweep), Machine(2)).notes if "replay memory" in note]


@pytest.mark.parametrize("scheduler", ["pbt", "pb2", {"type": "pbt", "perturb_every_env_steps": 6_000}])
def test_replay_memories_that_are_filled_for_a_whole_interval_are_told(scheduler: Any) -> None:
    (note,) = refills(scheduler, learning_starts=6_000)
    assert "for 6,000 env steps before it learns on" in note
    assert "compared every 6,000" in note
    assert refills(scheduler, learning_starts=5_999) == []


def test_nothing_is_said_of_memories_where_nothing_is_filled_again() -> None:
    assert refills("pbt", learning_starts=6_000, replay="none", train_batch_size=32) == []
    assert refills("asha", learning_starts=6_000) == []

"""The packed engine by itself: stacks that take turns, and what it does with trials that do not fit together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.typing import NDArray
from trials import make_task

from policies.errors import EnvError
from policies.portable.file import save_policy

if TYPE_CHECKING:
    from tune_jobs.training.packed import PackedEngine

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]


def engine_of(folder: Path, tasks: Sequence[dict[str, Any]], **settings: Any) -> PackedEngine:
    from tune_jobs.training.packed import PackedEngine

    engine = PackedEngine(**settings)
    for index, values in enumerate(tasks):
        engine.add(make_task(folder, trial_id=f"t{index:04d}", seed=100 + index, **values), None)
    return engine


def trained(
    folder: Path, tasks: Sequence[dict[str, Any]], num_iterations: int = 3, **settings: Any
) -> tuple[list[NDArray[Any]], int]:
    """Weights of each trial's policy after some iterations, and the number of stacks."""
    engine = engine_of(folder, tasks, **settings)
    for _ in range(num_iterations):
        results = engine.train_iteration()
    assert set(results) == {f"t{index:04d}" for index in range(len(tasks))}
    weights = [
        np.concatenate([layer.weight.ravel() for layer in engine.policy(name).network.layers])
        for name in sorted(results)
    ]
    num_stacks = len(engine._stacks)
    engine.close()
    return weights, num_stacks


TASKS: list[dict[str, Any]] = [
    {"lr": 1e-3},
    {"lr": 3e-3},
    {"activation": "relu"},
    {"hidden_sizes": [12]},
    {"gamma": 0.9},
]


def test_stacks_that_take_turns_train_what_one_stack_does(tmp_path: Path) -> None:
    # On a GPU one samples while the other's updates run; on the CPU the same code does one after the other.
    together, num_together = trained(tmp_path, TASKS)
    in_turns, num_in_turns = trained(tmp_path, TASKS, num_turns=2)
    assert (num_together, num_in_turns) == (1, 2)
    for one, other in zip(together, in_turns, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)


def test_trials_are_spread_evenly_over_the_turns(tmp_path: Path) -> None:
    engine = engine_of(tmp_path, TASKS, num_turns=2)
    assert sorted(len(stack.members) for stack in engine._stacks.values()) == [2, 3]
    for name in ("t0000", "t0002", "t0004"):
        engine.remove(name)
    engine.add(make_task(tmp_path, trial_id="t0005", seed=5), None)
    assert sorted(len(stack.members) for stack in engine._stacks.values()) == [1, 2]
    engine.close()


def test_trials_of_other_batch_shapes_get_stacks_of_their_own(tmp_path: Path) -> None:
    weights, num_stacks = trained(tmp_path, [{}, {"num_epochs": 3}, {"hidden_sizes": [8, 8]}])
    alone, _ = trained(tmp_path, [{}])
    assert num_stacks == 3
    np.testing.assert_allclose(weights[0], alone[0], atol=1e-4)


def test_a_trial_whose_environment_cannot_be_made_is_no_member(tmp_path: Path) -> None:
    engine = engine_of(tmp_path, [{}])
    with pytest.raises(EnvError, match="max_episode_steps"):
        engine.add(make_task(tmp_path, trial_id="bad", env_args={"max_episode_steps": 0}), None)
    assert set(engine.train_iteration()) == {"t0000"}
    engine.close()


def test_a_restored_algorithm_trains_with_the_failure_penalty_of_its_trial(tmp_path: Path) -> None:
    from policies.envs.make import FAILURE_PENALTY
    from policies.packed.to_rllib import algorithm_from_checkpoint

    penalties = {}
    for name, penalty in (("with", -7.0), ("without", None)):
        engine = engine_of(tmp_path, [{"failure_penalty": penalty}])
        engine.train_iteration()
        engine.save("t0000", tmp_path / name)
        save_policy(engine.policy("t0000"), tmp_path / name)
        engine.close()
        algorithm = algorithm_from_checkpoint(tmp_path / name)
        penalties[name] = algorithm.config.env_config.get(FAILURE_PENALTY)
        algorithm.stop()
    assert penalties == {"with": -7.0, "without": None}

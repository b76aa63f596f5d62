"""An Algorithm that takes over another trial's checkpoint, and acts by its own hyperparameters."""

from __future__ import annotations

import dataclasses
from collections.abc import Sized
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
import torch
from trials import make_task

from analysis.records import ChangeRecord
from policies.errors import CheckpointError
from policies.packed.member import Weights
from policies.portable.file import save_policy
from tune_jobs.training.protocol import TrialTask

if TYPE_CHECKING:
    from tune_jobs.training.rllib import RLlibEngine

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

CHANGE = ChangeRecord(
    iteration=2, num_env_steps=200, source_trial_id="t0009", source_iteration=3, before={}, after={}, time=0.0
)


def learner(engine: RLlibEngine) -> Any:
    return engine.algorithm.learner_group._learner


def optimizer(engine: RLlibEngine) -> torch.optim.Optimizer:
    from ray.rllib.core import DEFAULT_MODULE_ID

    [(_, found)] = learner(engine).get_optimizers_for_module(DEFAULT_MODULE_ID)
    return cast("torch.optim.Optimizer", found)


def tensors(engine: RLlibEngine) -> Weights:
    """Everything the module holds: weights, target networks, observation statistics."""
    from ray.rllib.core import DEFAULT_MODULE_ID

    state = learner(engine).module[DEFAULT_MODULE_ID].state_dict()
    return {name: value.detach().numpy().copy() for name, value in state.items()}


def moments(engine: RLlibEngine) -> list[Weights]:
    return [
        {name: value.detach().numpy().copy() for name, value in state.items()}
        for state in optimizer(engine).state.values()
    ]


def assert_same(first: Sized, second: Sized) -> None:
    assert len(first) == len(second) > 0
    np.testing.assert_equal(first, second)


def trained(tmp_path: Path, algorithm: str, **values: Any) -> tuple[RLlibEngine, Path, TrialTask]:
    """(engine, its checkpoint, its task) after three iterations as trial t0009."""
    from tune_jobs.training.rllib import RLlibEngine

    task = make_task(tmp_path, algorithm, trial_id="t0009", **values)
    engine = RLlibEngine()
    engine.build(task, None)
    for _ in range(3):
        engine.train_iteration()
    folder = tmp_path / "000003"
    folder.mkdir()
    engine.save(folder)
    save_policy(engine.policy(), folder)
    return engine, folder, task


def taken_over(folder: Path, task: TrialTask, **values: Any) -> tuple[RLlibEngine, TrialTask]:
    """(engine, its task) of another trial, two iterations and 200 env steps far, that takes the checkpoint over."""
    from tune_jobs.training.rllib import RLlibEngine

    task = dataclasses.replace(
        task,
        trial_id="t0001",
        seed=77 * 1024,
        hyperparams={**task.hyperparams, **values},
        changes=(CHANGE,),
        num_env_steps=200,
        num_iterations=2,
    )
    engine = RLlibEngine()
    engine.build(task, folder)
    return engine, task


@pytest.mark.parametrize(
    ("algorithm", "old", "new", "acting"),
    [
        ("ppo", {"normalize_observations": True}, {"gamma": 0.5}, {}),
        ("dqn", {}, {"adam_beta1": 0.5, "optimizer_epsilon": 0.1}, {"betas": (0.5, 0.999), "eps": 0.1}),
        ("dqn", {"optimizer": "rmsprop", "tau": 0.1}, {"rmsprop_rho": 0.5}, {"alpha": 0.5}),
    ],
)  # fmt: skip
def test_new_values_act_on_the_copied_weights_moments_and_targets(
    tmp_path: Path, algorithm: str, old: dict[str, Any], new: dict[str, Any], acting: dict[str, Any]
) -> None:
    source, folder, task = trained(tmp_path, algorithm, lr=1e-3, **old)
    engine, task = taken_over(folder, task, lr=0.02, **new)
    assert_same(tensors(engine), tensors(source))
    assert_same(moments(engine), moments(source))
    settings = optimizer(engine).param_groups[0]
    assert settings["lr"] == 0.02
    assert {name: settings[name] for name in acting} == acting
    # And after updates, which is where schedules set it again.
    stats = engine.train_iteration()
    assert settings["lr"] == pytest.approx(0.02)
    assert stats.learner["lr"] == pytest.approx(0.02)
    if "gamma" in new:
        assert learner(engine).config.gamma == new["gamma"]
    assert any((a != b).any() for a, b in zip(tensors(engine).values(), tensors(source).values(), strict=True))
    engine.close()
    source.close()


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_the_trials_own_counts_go_on_and_do_so_again_after_a_restore(tmp_path: Path, algorithm: str) -> None:
    source, folder, task = trained(tmp_path, algorithm)
    source.close()
    engine, task = taken_over(folder, task, lr=0.02)
    stats = engine.train_iteration()
    # An iteration; with DQN its first env steps refill the replay memory.
    assert 200 < stats.num_env_steps < 200 + 128 + 64
    assert engine.policy().training["iteration"] == 3
    own = tmp_path / "000003-own"
    own.mkdir()
    engine.save(own)
    save_policy(engine.policy(), own)
    engine.build(dataclasses.replace(task, num_env_steps=stats.num_env_steps, num_iterations=3), own)
    assert optimizer(engine).param_groups[0]["lr"] == 0.02
    after = engine.train_iteration()
    assert stats.num_env_steps < after.num_env_steps < stats.num_env_steps + 128 + 64
    assert engine.policy().training["iteration"] == 4
    engine.close()


def test_a_trial_has_random_numbers_of_its_own_after_it_took_over(tmp_path: Path) -> None:
    source, folder, task = trained(tmp_path, "ppo")
    first, _ = taken_over(folder, task)
    episodes = first.train_iteration().episodes
    first.close()
    again, _ = taken_over(folder, task)
    assert again.train_iteration().episodes == episodes
    again.close()
    other, _ = taken_over(folder, dataclasses.replace(task, seed=78 * 1024))
    assert source.train_iteration().episodes != episodes
    other.close()
    source.close()


def test_weights_of_another_shape_are_refused(tmp_path: Path) -> None:
    source, folder, task = trained(tmp_path, "ppo")
    source.close()
    with pytest.raises(CheckpointError, match="cannot restore"):
        taken_over(folder, task, hidden_sizes=(16,))

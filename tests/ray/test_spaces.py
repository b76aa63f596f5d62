"""Observations of any precision and actions with any bounds: both engines, their policies, and what is restored."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from trials import make_task, run_trial

from policies.acting.evaluate import Evaluator
from policies.acting.load import load_policy
from policies.acting.policy import WeightsPolicy
from tune_jobs.training.protocol import TrialTask

if TYPE_CHECKING:
    from tune_jobs.training.packed import PackedEngine
    from tune_jobs.training.rllib import RLlibEngine

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

IMAGE = {"env_args": {"dtype": "float64", "shape": [12, 10, 1]}, "conv_filters": [[4, 4, 2]]}
# Those of RLlib's engine that packs have too are trained by both.
CASES = {
    "dqn, double": ("dqn", {"env_args": {"dtype": "float64"}, "normalize_observations": True}),
    "dqn, half, prioritized, n-step": (
        "dqn", {"env_args": {"dtype": "float16"}, "replay": "prioritized", "n_step": 4, "gamma": 0.9}
    ),
    "dqn, images of doubles": ("dqn", IMAGE),
    "ppo, half": ("ppo", {"env_args": {"dtype": "float16"}, "normalize_observations": True}),
    "ppo, long double": ("ppo", {"env_args": {"dtype": "longdouble"}}),
    "ppo, images of doubles": ("ppo", IMAGE),
}  # fmt: skip
BOUNDS = [[0, None], [None, 0.5], [-2, 3], [None, None]]


def engines() -> tuple[RLlibEngine, PackedEngine]:
    from tune_jobs.training.packed import PackedEngine
    from tune_jobs.training.rllib import RLlibEngine

    return RLlibEngine(), PackedEngine()


def train_packed(engine: PackedEngine, task: TrialTask) -> Path:
    """Two iterations and a checkpoint, as a pack saves them; returns its folder."""
    from policies.portable.file import save_policy

    engine.add(task, None)
    for _ in range(2):
        (result,) = engine.train_iteration().values()
        assert not isinstance(result, Exception), result
    folder = Path(task.sweep_place) / "packed"
    folder.mkdir()
    save_policy(engine.policy(task.trial_id), folder)
    engine.save(task.trial_id, folder)
    return folder


@pytest.fixture
def checkpoints(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[TrialTask, list[Path]]]:
    """A trial's newest checkpoint by each engine that can train it."""
    algorithm, values = request.param
    task = make_task(tmp_path, algorithm, env_id="TestPrecise-v0", **values)
    rllib, packed = engines()
    progress = run_trial(task, rllib)
    assert progress.status == "completed", progress
    folders = [tmp_path / progress.checkpoints[-1].path]
    if "conv_filters" not in values:
        folders.append(train_packed(packed, task))
    yield task, folders
    rllib.close()
    packed.close()


def train_on(folder: Path) -> Any:
    """Restore, train an iteration, and return the Algorithm."""
    from policies.packed.to_rllib import algorithm_from_checkpoint
    from policies.rllib.restore import restore_algorithm

    is_packed = (folder / "packed").is_dir()
    algorithm = algorithm_from_checkpoint(folder) if is_packed else restore_algorithm(folder / "rllib")
    before = {name: value.clone() for name, value in learner_weights(algorithm).items()}
    for _ in range(3):
        algorithm.train()
    after = learner_weights(algorithm)
    assert all(np.isfinite(value.numpy()).all() for value in after.values())
    assert any(not np.array_equal(after[name], value) for name, value in before.items())
    return algorithm


def learner_weights(algorithm: Any) -> dict[str, torch.Tensor]:
    module = algorithm.learner_group._learner.module["default_policy"]
    return {name: value.detach().cpu() for name, value in module.named_parameters()}


@pytest.mark.parametrize("checkpoints", CASES.values(), ids=CASES, indirect=True)
def test_observations_of_any_precision(checkpoints: tuple[TrialTask, list[Path]]) -> None:
    task, folders = checkpoints
    for folder in folders:
        with Evaluator(task.env_id, task.env_args, task.evaluation_seeds) as evaluator:
            assert np.isfinite(evaluator.run(load_policy(folder)).returns).all()
        train_on(folder).stop()


def test_statistics_count_every_observation_whatever_the_transitions_wait_for(tmp_path: Path) -> None:
    task = make_task(tmp_path, "dqn", n_step=7, normalize_observations=True, num_envs=2)
    rllib, packed = engines()
    rllib.build(task, None)
    packed.add(task, None)
    packed.train_iteration()
    (stack,) = packed._stacks.values()
    assert stack.member(task.trial_id).weights["obs_count"] == stack.member(task.trial_id).num_env_steps == 60
    num_env_steps = rllib.train_iteration().num_env_steps
    module = rllib.algorithm.learner_group._learner.module["default_policy"]
    assert int(module.obs_count) == num_env_steps >= 60
    rllib.close()
    packed.close()


@pytest.mark.parametrize("checkpoints", [("ppo", {"env_args": {"bounds": BOUNDS}})], indirect=True)
def test_no_action_leaves_its_bounds(checkpoints: tuple[TrialTask, list[Path]]) -> None:
    """The env refuses one that does."""
    task, folders = checkpoints
    for folder in folders:
        policy = load_policy(folder)
        with Evaluator(task.env_id, task.env_args, task.evaluation_seeds) as evaluator:
            evaluator.run(policy)
        algorithm = train_on(folder)
        # RLlib's own way of stepping, for whole episodes.
        algorithm.env_runner.sample(num_episodes=2, explore=True)
        drawn = 3 * np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
        sent = algorithm.env_runner._for_env(drawn)
        np.testing.assert_array_equal(sent[:, 0], np.maximum(drawn[:, 0], 0))
        assert isinstance(policy, WeightsPolicy)
        np.testing.assert_array_equal(sent, policy._to_actions(np.concatenate([drawn, drawn], axis=1)))
        algorithm.stop()

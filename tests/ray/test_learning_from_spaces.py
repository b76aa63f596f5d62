"""Both engines learn from what is observed in each kind of space, and their policies take what the env gives."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import pytest
from trials import make_task, run_trial, train_pack

from policies.acting.evaluate import Evaluator
from policies.acting.load import load_policy
from policies.acting.policy import NetworkPolicy, Policy
from tune_jobs.spec.sections import EvaluationSpec, StopSpec

if TYPE_CHECKING:
    from tune_jobs.training.protocol import TrialTask

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

KINDS = [
    "discrete", "multi-discrete", "multi-binary", "matrix of whole numbers", "infinite bounds", "tuple", "nested dict",
]  # fmt: skip
NUM_STEPS = 16
# One who always takes the same action gets 4 of 16; who reads the observation gets all.
LEARNED = 14.0
SEEDS = tuple(range(500, 520))
VALUES: dict[str, dict[str, Any]] = {
    "ppo": {
        "hidden_sizes": (32,), "lr": 0.01, "gamma": 0.0, "num_envs": 8, "train_batch_size": 512, "minibatch_size": 128,
        "num_epochs": 6,
    },
    "dqn": {
        "hidden_sizes": (32,), "lr": 0.005, "gamma": 0.0, "learning_starts": 100, "env_steps_per_iteration": 500,
        "train_batch_size": 64, "updates_per_env_step": 0.5, "train_freq": 2, "epsilon_decay": 1000,
    },
}  # fmt: skip
NUM_ITERATIONS = 8


def task_of(folder: Path, algorithm: str, kind: str, seed: int = 0) -> TrialTask:
    return make_task(
        folder, algorithm, **VALUES[algorithm], trial_id=f"t{seed:04d}", seed=1024 * (seed + 1),
        env_id="TestSecret-v0", env_args={"kind": kind}, stop=StopSpec(num_iterations=NUM_ITERATIONS),
        evaluation=EvaluationSpec(every_iterations=NUM_ITERATIONS, num_episodes=len(SEEDS)), evaluation_seeds=SEEDS,
    )  # fmt: skip


def return_on_the_envs_own_observations(policy: Policy, kind: str) -> float:
    """A mean return, from the environment as its author registered it: no wrapper of ours."""
    env, total = gym.make("TestSecret-v0", kind=kind), 0.0
    for seed in SEEDS:
        observation, _ = env.reset(seed=seed)
        for _ in range(NUM_STEPS):
            observation, reward, *_ = env.step(policy.act(observation))
            total += float(reward)
    return total / len(SEEDS)


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_pack_learns_from_it(kind: str, algorithm: str, tmp_path: Path) -> None:
    tasks = [task_of(tmp_path, algorithm, kind, seed) for seed in range(3)]
    for policy in train_pack(tasks, tmp_path, NUM_ITERATIONS):
        assert return_on_the_envs_own_observations(policy, kind) >= LEARNED
        with Evaluator("TestSecret-v0", {"kind": kind}, SEEDS) as evaluator:
            assert evaluator.run(policy).mean_return >= LEARNED


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_a_trial_of_rllibs_learns_from_it_and_its_checkpoint_does_as_the_packs(algorithm: str, tmp_path: Path) -> None:
    from tune_jobs.training.rllib import RLlibEngine

    kind, engine = "nested dict", RLlibEngine()
    progress = run_trial(task_of(tmp_path, algorithm, kind), engine)
    engine.close()
    assert progress.status == "completed", progress
    policy = load_policy(tmp_path / progress.checkpoints[-1].path)
    assert isinstance(policy, NetworkPolicy)
    assert return_on_the_envs_own_observations(policy, kind) >= LEARNED

"""A pack learns as RLlib does: what its trials reach, and how soon, over seeds and learning rates.

Both engines start a trial from the same weights, so trials are compared pair by pair. Nothing else is equal: actions
are drawn with other random numbers, and RLlib's batches have a row more for each chunk of an episode.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from analysis.statistics import Estimate, paired_difference
from policies.acting.evaluate import Evaluator
from policies.acting.policy import NetworkPolicy
from policies.portable.file import PortablePolicy
from tune_jobs.spec.sections import CheckpointSpec, EvaluationSpec, StopSpec
from tune_jobs.training.packed import PackedEngine
from tune_jobs.training.protocol import IterationStats, TrialTask
from tune_jobs.training.rllib import RLlibEngine

pytestmark = [pytest.mark.ray, pytest.mark.learning]

LEARNING_RATES = (4e-3, 8e-3, 1.5e-2)
SEEDS = range(10)
NUM_ITERATIONS = 26  # of 512 env steps
THRESHOLD, WINDOW = 75.0, 20
"""CartPole is on its way to being solved where as many episodes in a row have this mean return; random play has 22."""
EVALUATION_SEEDS = tuple(range(5_000, 5_020))
LEVEL = 0.99
"""Of the intervals. Two runs of one and the same engine would leave one of them out once in a hundred."""
MAX_WIDTHS = {"return": 250.0, "env steps": 2_500.0}
"""Returns go up to 500; an interval that is wider than that would have nothing to say."""


def make_tasks(folder: Path) -> list[TrialTask]:
    hyperparams = {
        "hidden_sizes": [32], "gamma": 0.98, "gae_lambda": 0.8, "num_envs": 16, "train_batch_size": 512,
        "minibatch_size": 256, "num_epochs": 8,
    }  # fmt: skip
    return [
        TrialTask(
            sweep_place=str(folder),
            trial_id=f"lr{lr:g}-seed{seed}",
            seed=1024 * seed,
            algorithm="ppo",
            hyperparams={**hyperparams, "lr": lr},
            env_id="CartPole-v1",
            env_args={},
            stop=StopSpec(num_iterations=NUM_ITERATIONS),
            evaluation=EvaluationSpec(),
            checkpoints=CheckpointSpec(),
            evaluation_seeds=EVALUATION_SEEDS,
        )
        for lr in LEARNING_RATES
        for seed in SEEDS
    ]


class Curve:
    """What a trial's training gave."""

    def __init__(self) -> None:
        self.returns: list[float] = []
        self.env_steps = 0
        self.reached: int | None = None
        """Env steps to the threshold."""

    def add(self, stats: IterationStats | Exception) -> None:
        assert isinstance(stats, IterationStats)
        self.returns += [episode_return for episode_return, _ in stats.episodes]
        self.env_steps = stats.num_env_steps
        recent = self.returns[-WINDOW:]
        if self.reached is None and len(recent) == WINDOW and np.mean(recent) >= THRESHOLD:
            self.reached = stats.num_env_steps


def train_packed(tasks: list[TrialTask]) -> dict[str, tuple[Curve, PortablePolicy]]:
    engine = PackedEngine(env_kind="vectorised")
    curves = {task.trial_id: Curve() for task in tasks}
    for task in tasks:
        engine.add(task, None)
    for _ in range(NUM_ITERATIONS):
        for trial_id, stats in engine.train_iteration().items():
            curves[trial_id].add(stats)
    found = {trial_id: (curve, engine.policy(trial_id)) for trial_id, curve in curves.items()}
    engine.close()
    return found


def train_rllib(tasks: list[TrialTask]) -> dict[str, tuple[Curve, PortablePolicy]]:
    engine, found = RLlibEngine(), {}
    for task in tasks:
        engine.build(task, None)
        curve = Curve()
        for _ in range(NUM_ITERATIONS):
            curve.add(engine.train_iteration())
        found[task.trial_id] = (curve, engine.policy())
    engine.close()
    return found


def scores(found: dict[str, tuple[Curve, PortablePolicy]]) -> dict[str, list[float]]:
    with Evaluator("CartPole-v1", {}, EVALUATION_SEEDS) as evaluator:
        returns = [float(np.mean(evaluator.run(NetworkPolicy(policy)).returns)) for _, policy in found.values()]
    # A trial that never got there counts as if it had at the end of its budget.
    steps = [float(curve.env_steps if curve.reached is None else curve.reached) for curve, _ in found.values()]
    return {"return": returns, "env steps": steps}


def test_a_pack_learns_as_rllib_does(ray_session: None, tmp_path: Path) -> None:
    tasks = make_tasks(tmp_path)
    packed, rllib = train_packed(tasks), train_rllib(tasks)
    assert list(packed) == list(rllib)
    ours, theirs = scores(packed), scores(rllib)
    for found, both in ((packed, ours), (rllib, theirs)):
        # There is something to compare: most learn, and few have done so at once.
        assert np.mean(both["return"]) > 100
        assert np.mean([curve.reached is not None for curve, _ in found.values()]) > 0.7
    for name, width in MAX_WIDTHS.items():
        difference: Estimate = paired_difference(
            ours[name], theirs[name], rng=np.random.default_rng(0), num_resamples=10_000, level=LEVEL
        )
        print(f"{name}: {np.mean(ours[name]):.1f} packed, {np.mean(theirs[name]):.1f} rllib, difference {difference}")
        assert difference.upper - difference.lower < width, name
        assert difference.lower <= 0.0 <= difference.upper, name

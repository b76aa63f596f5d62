"""The tasks of the benchmark: ARLBench's, as sweep files, with what its authors' optimisers reached.

Sources: Becktepe et al. 2024, "ARLBench: Flexible and Efficient Benchmarking for Hyperparameter Optimization in
Reinforcement Learning", and its published results (github.com/automl/arlbench, branch `experiments`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec

HERE = Path(__file__).parent

TUNING_SEEDS = (0, 1, 2)
"""Training seeds of every point; ARLBench tunes on seeds of 0 to 9."""
TEST_SEEDS = (100, 101, 102, 103, 104)
"""Training seeds on which a run's best point is judged, and nothing is chosen; ARLBench's begin at 100, too."""
EVALUATION_SEEDS = tuple(range(1_000_000, 1_000_128))
"""128 greedy episodes end a training, as in ARLBench."""
_EVALUATED_AS = {"tests.benchmarks.search.envs:EndingMountainCar-v0": "MountainCar-v0"}
"""Environments whose greedy episodes are another's, which are played all at once: how an episode ends is not seen."""


@dataclass(frozen=True)
class Task:
    """One task."""

    name: str
    published: dict[str, float]
    """The mean over five runs of the best point's score, by method."""

    @property
    def file(self) -> Path:
        """Its sweep file."""
        return HERE / "tasks" / f"{self.name}.yaml"

    @cached_property
    def spec(self) -> SweepSpec:
        """The sweep."""
        return load_spec(self.file)

    def with_spec(self, spec: SweepSpec) -> Task:
        """Return this task with another sweep."""
        found = replace(self)
        vars(found)["spec"] = spec
        return found

    @property
    def evaluation_env_id(self) -> str:
        """The environment in which a training's greedy episodes are played."""
        return _EVALUATED_AS.get(self.spec.env.id, self.spec.env.id)

    @property
    def evaluation_seeds(self) -> tuple[int, ...]:
        """The seeds of the episodes that end a training."""
        return EVALUATION_SEEDS

    @property
    def best_published(self) -> float:
        """The best method's."""
        return max(self.published.values())


def _task(name: str, random: float, smac: float, hyperband: float, pbt: float) -> Task:
    return Task(name, {"random": random, "SMAC": smac, "SMAC + HyperBand": hyperband, "PBT": pbt})


TASKS = {
    task.name: task
    for task in (
        _task("cartpole-dqn", 485.7, 500.0, 466.7, 421.3),
        _task("cartpole-ppo", 500.0, 500.0, 500.0, 500.0),
        _task("acrobot-dqn", -77.7, -74.6, -74.6, -79.2),
        _task("pendulum-ppo", -873.0, -689.0, -704.0, -720.0),
        _task("mountaincar-dqn", -108.7, -104.0, -107.9, -103.2),
        _task("mountaincar-continuous-ppo", 96.8, 96.6, 96.1, 98.2),
        _task("lunarlander-dqn", 67.1, 112.5, 77.7, 107.4),
    )
}

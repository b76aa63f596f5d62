"""The trained tasks: what every iteration of every training showed, as arrays."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.records import IterationRecord
from tests.benchmarks.choice.collecting import DATA

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Task:
    """One task; arrays are of shape (settings, seeds, iterations), or (settings, seeds, evaluations)."""

    name: str
    points: tuple[dict[str, Any], ...]
    num_env_steps: Floats
    """Env steps after each iteration."""
    training_returns: Floats
    """Mean return of the last 100 training episodes; NaN before the first has ended."""
    iteration_returns: Floats
    """Mean return of the episodes that ended in the iteration; NaN if none did."""
    num_episodes: Floats
    evaluated_at: Floats
    """Env steps of each evaluation, shape (evaluations,)."""
    evaluations: Floats
    """Mean return of the greedy episodes of each evaluation."""

    @property
    def num_env_steps_each(self) -> int:
        """The env steps of each training."""
        return int(self.num_env_steps.max())

    def iterations(self) -> list[list[list[IterationRecord]]]:
        """Return the records of all iterations, by setting and seed; all episodes of one have their mean return."""
        settings, seeds = self.shape
        return [[self._training(setting, seed) for seed in range(seeds)] for setting in range(settings)]

    def _training(self, setting: int, seed: int) -> list[IterationRecord]:
        evaluated = dict(zip(self.evaluated_at.tolist(), self.evaluations[setting, seed].tolist(), strict=True))
        columns = (self.num_env_steps, self.training_returns, self.iteration_returns, self.num_episodes)
        rows = zip(*(column[setting, seed].tolist() for column in columns), strict=True)
        return [
            IterationRecord(
                iteration=index + 1,
                num_env_steps=int(steps),
                num_episodes=0,
                time_s=0.0,
                training_return=training,
                evaluation_return=evaluated.get(steps),
                episode_returns=(mean,) * int(count),
            )
            for index, (steps, training, mean, count) in enumerate(rows)
        ]

    @property
    def shape(self) -> tuple[int, int]:
        """The number of settings and the number of seeds."""
        return self.evaluations.shape[0], self.evaluations.shape[1]


def read_task(name: str) -> Task:
    """Read the data of one task.

    Raises:
        ValueError: A training is incomplete.
    """
    table = pd.read_parquet(DATA / f"{name}.parquet").astype("float64")
    about = json.loads((DATA / f"{name}.json").read_text())
    num_points, num_seeds = int(table["point"].max()) + 1, int(table["seed"].max()) + 1
    table = table.sort_values(["point", "seed", "num_env_steps"])
    lengths = table.groupby(["point", "seed"]).size()
    if len(lengths) != num_points * num_seeds or lengths.nunique() != 1:
        raise ValueError(f"{name}: {len(lengths)} trainings of {lengths.min()} to {lengths.max()} iterations")

    def column(key: str) -> Floats:
        values: Floats = table[key].to_numpy().reshape(num_points, num_seeds, -1)
        return values

    evaluations = column("evaluation_return")
    evaluated = np.isfinite(evaluations).all(axis=(0, 1))
    if (np.isfinite(evaluations).any(axis=(0, 1)) != evaluated).any():
        raise ValueError(f"{name}: trainings were not evaluated at the same iterations")
    num_episodes = column("num_episodes")
    with np.errstate(invalid="ignore"):
        iteration_returns = column("sum_of_returns") / num_episodes
    steps = column("num_env_steps")
    return Task(
        name=name,
        points=tuple(about["points"]),
        num_env_steps=steps,
        training_returns=column("training_return"),
        iteration_returns=iteration_returns,
        num_episodes=num_episodes,
        evaluated_at=steps[0, 0, evaluated],
        evaluations=evaluations[:, :, evaluated],
    )

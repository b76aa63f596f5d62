"""Whether stated intervals hold the truth as often as they say, and settings are the best as often as is said.

The seeds of a task are taken for all that there are: from them as many as a person would train are drawn, with
replacement, so that the true mean of each setting is known. Which of 20 settings is the best would be one and the same
question in every draw, so there each draw has a random half of them.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from analysis.statistics import probability_of_being_best, seed_intervals
from tests.benchmarks.choice.rules import SCORES
from tests.benchmarks.choice.trained import Floats, Task

EDGES = (0.0, 0.1, 0.3, 0.5, 0.7, 1.0)


@dataclass(frozen=True)
class Calibration:
    """What was said of a task's settings, and what was so; arrays are of shape (draws, settings), or half of those."""

    covered: Floats
    """1 where the interval of a setting holds its true mean."""
    probabilities: Floats
    """The stated probabilities to be the best."""
    is_best: Floats
    """1 where a setting is the best in truth."""

    @property
    def coverage(self) -> float:
        """The share of intervals that hold the truth."""
        return float(self.covered.mean())


def calibrate(task: Task, num_seeds: int, num_draws: int) -> Calibration:
    """Draw seeds of all settings, and compare what is said of them by `final` with the truth."""
    scores = SCORES["final"](task)
    truth = scores.mean(axis=1)
    covered, probabilities, is_best = [], [], []
    for draw in range(num_draws):
        rng = np.random.default_rng([1, draw])
        drawn = np.take_along_axis(scores, rng.integers(scores.shape[1], size=(len(scores), num_seeds)), axis=1)
        intervals = seed_intervals(drawn.tolist())
        covered.append([item.lower <= mean <= item.upper for item, mean in zip(intervals, truth, strict=True)])
        half = rng.permutation(len(scores))[: len(scores) // 2]
        probabilities.append(probability_of_being_best(drawn[half].tolist(), rng=rng))
        is_best.append(truth[half] == truth[half].max())
    return Calibration(*(np.array(values, dtype=np.float64) for values in (covered, probabilities, is_best)))


def by_bin(found: list[Calibration]) -> list[tuple[str, int, float, float]]:
    """Return for each range of stated probabilities: its name, how many, what was said, and what was so, as means."""
    said = np.concatenate([item.probabilities.ravel() for item in found])
    so = np.concatenate([item.is_best.ravel() for item in found])
    rows = []
    for low, high in itertools.pairwise(EDGES):
        inside = (said >= low) & ((said < high) | (high == EDGES[-1]))
        mean_said, mean_so = (float(values[inside].mean()) if inside.any() else np.nan for values in (said, so))
        rows.append((f"{100 * low:.0f} to {100 * high:.0f} %", int(inside.sum()), mean_said, mean_so))
    return rows

"""What is told of the setting that a launch names, beside what is so.

The setting was named by the seeds that are told of, so that its score is a lucky one, and its interval lies too high.
Seeds are drawn as in `calibration`: with replacement, so that the true mean of each setting is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.objectives import expected_means
from analysis.statistics import seed_intervals
from tests.benchmarks.choice.regret import DEFAULT
from tests.benchmarks.choice.rules import SCORES, Seeds
from tests.benchmarks.choice.trained import Floats, Task


@dataclass(frozen=True)
class Named:
    """What was told of the settings named in a task, and what was so; arrays are of shape (draws,)."""

    covered: Floats
    """1 where the interval of the named setting holds its true mean."""
    score_gaps: Floats
    """Its score less its true mean, as a share of the best true mean less the median one."""
    expected_gaps: Floats
    """The same of what is expected of more seeds."""

    @property
    def coverage(self) -> float:
        """The share of intervals that hold the truth."""
        return float(self.covered.mean())


def named_settings(task: Task, num_draws: int) -> Named:
    """Let a launch name a setting by `final`, again and again, and compare what is told of it with the truth."""
    scores = SCORES["final"](task)
    truth = scores.mean(axis=1)
    scale = float(truth.max() - np.median(truth))
    covered, score_gaps, expected_gaps = [], [], []
    for draw in range(num_draws):
        rng = np.random.default_rng([2, draw])
        drawn = np.take_along_axis(scores, rng.integers(scores.shape[1], size=scores.shape), axis=1)
        seeds = Seeds(drawn, rng)
        named = DEFAULT.way.choose(seeds)
        shown = seeds.shown()
        interval = seed_intervals(shown)[named]
        covered.append(interval.lower <= truth[named] <= interval.upper)
        score_gaps.append((interval.mean - truth[named]) / scale)
        expected_gaps.append((expected_means(shown)[named] - truth[named]) / scale)
    return Named(*(np.array(values, dtype=np.float64) for values in (covered, score_gaps, expected_gaps)))

"""One run of an optimiser: 32 points of 3 seeds each, one point after another, then its best on seeds of its own.

A run is a generator that yields the trainings it wants and is sent their returns, so that runs of all methods train
side by side. It depends on the method, its number and the trainings' returns alone: a benchmark that was killed asks
for the same again, and finds it made.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tests.benchmarks.search.tasks import TEST_SEEDS, TUNING_SEEDS, Task
from tests.benchmarks.search.trainings import Wanted
from tune_jobs.plan.points import point_hyperparams
from tune_jobs.search.history import KnownPoint
from tune_jobs.search.proposal import next_point

NUM_RUNS = 5
METHODS = ("random", "tpe", "gp", "forest")
"""The methods that choose points for whole trainings."""

Returns = Sequence[float | None]


@dataclass(frozen=True)
class Run:
    """What one run found."""

    scores: tuple[float, ...]
    """Of each point the mean over its seeds, in the order in which they were tried; -inf if a seed failed."""
    best: Mapping[str, Any]
    """The point of the highest score; of equals the first."""
    test: float
    """Its mean over the test seeds; -inf if one failed."""

    @property
    def score(self) -> float:
        """The best point's: the maximum over noisy scores, as ARLBench gives it."""
        return max(self.scores)


def mean_or_worst(returns: Returns) -> float:
    """Return the mean of a point's seeds; -inf, below all returns, if one of them failed."""
    known = [value for value in returns if value is not None and math.isfinite(value)]
    return sum(known) / len(known) if len(known) == len(returns) else -math.inf


def finite(score: float) -> float | None:
    """Return a score as JSON has it: null where a seed failed."""
    return score if math.isfinite(score) else None


def run(task: Task, method: str, number: int) -> Generator[list[Wanted], list[float | None], Run]:
    """Run one optimiser.

    Args:
        task: The task.
        method: A `search.type` of sweeps.
        number: The run's number, which is the seed of its draws.
    """
    spec = task.spec
    known: list[KnownPoint] = []

    def asked(index: int) -> dict[str, Any]:
        return next_point(
            method, spec.space, known, index, seed=number,
            num_startup_trials=spec.search.num_startup_trials,
            check=lambda point: point_hyperparams(spec, point, None),
        )  # fmt: skip

    while len(known) < spec.num_samples:
        # What does not depend on results is trained side by side.
        num_drawn = spec.num_samples if method == "random" else spec.search.num_startup_trials
        indices = range(num_drawn) if not known else range(len(known), len(known) + 1)
        points = [asked(index) for index in indices]
        returns = yield [Wanted(point, seed) for point in points for seed in TUNING_SEEDS]
        for place, point in enumerate(points):
            scores = returns[place * len(TUNING_SEEDS) : (place + 1) * len(TUNING_SEEDS)]
            known.append(KnownPoint(point, scores=tuple(scores)))
    means = tuple(mean_or_worst(item.scores) for item in known)
    best = known[means.index(max(means))].point
    test = yield [Wanted(best, seed) for seed in TEST_SEEDS]
    return Run(means, best, mean_or_worst(test))

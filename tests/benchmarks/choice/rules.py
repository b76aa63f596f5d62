"""Ways to choose a setting: what each scores a training by, and which seeds it asks for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from analysis.objectives import expected_means, trial_score
from analysis.racing import Race
from analysis.records import Objective
from tests.benchmarks.choice.trained import Floats, Task


def by_objective(objective: Objective) -> Callable[[Task], Floats]:
    """Score trainings by an objective of the product."""

    def scores(task: Task) -> Floats:
        return np.array(
            [
                [trial_score(seed, objective, num_env_steps=task.num_env_steps_each) for seed in setting]
                for setting in task.iterations()
            ],
            dtype=np.float64,
        )

    return scores


def last_training_return(task: Task) -> Floats:
    """Score trainings by the mean return of their last 100 training episodes, as Ray Tune does by default."""
    return task.training_returns[:, :, -1]


def last_evaluation(task: Task) -> Floats:
    """Score trainings by their last greedy evaluation."""
    return task.evaluations[:, :, -1]


SCORES: Mapping[str, Callable[[Task], Floats]] = {
    "best evaluation, as before": by_objective("best"),
    "last training return": last_training_return,
    "last evaluation": last_evaluation,
    "area": by_objective("area"),
    "final": by_objective("final"),
}


class Seeds:
    """The trainings of one draw: each setting shows its seeds in an order of their own, as many as it is asked for."""

    def __init__(self, scores: Floats, rng: np.random.Generator) -> None:
        self._scores = scores
        self._order = np.argsort(rng.random(scores.shape), axis=1)
        self._settings: list[int] = rng.permutation(len(scores)).tolist()
        self.num_used = np.zeros(len(scores), dtype=np.int64)

    def train(self, settings: list[int]) -> None:
        """Train each of these settings once more; they may repeat."""
        for index in settings:
            self.num_used[index] += 1

    def some(self, count: int) -> list[int]:
        """Return as many settings, drawn at random."""
        return self._settings[:count]

    def shown(self) -> list[list[float]]:
        """Return the scores seen so far, by setting."""
        return [self._scores[index, self._order[index, :used]].tolist() for index, used in enumerate(self.num_used)]

    def unseen(self, setting: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """Return the indices of the seeds of a setting that were not trained."""
        return self._order[setting, self.num_used[setting] :]


@dataclass(frozen=True)
class MeanOfSeeds:
    """As many seeds for each setting, and the best mean; with a half, half of them, drawn at random, get one more."""

    num_seeds: float

    def choose(self, seeds: Seeds) -> int:
        """Train, and return the chosen setting."""
        everything = list(range(len(seeds.num_used)))
        for _ in range(int(self.num_seeds)):
            seeds.train(everything)
        seeds.train(seeds.some(round(len(everything) * (self.num_seeds % 1))))
        means = [float(np.mean(item)) for item in seeds.shown()]
        return int(np.argmax(means))


@dataclass(frozen=True)
class RaceOfLeaders:
    """One seed a setting, then a race of the leading ones, as `replicate` and `launch` do."""

    top: int
    num_seeds: int

    def choose(self, seeds: Seeds) -> int:
        """Train, and return the chosen setting."""
        everything = list(range(len(seeds.num_used)))
        seeds.train(everything)
        first = expected_means(seeds.shown())
        leading = sorted(everything, key=lambda index: -first[index])
        race = Race(tuple(leading[: self.top]), self.num_seeds)
        num_done = 0
        while points := race.next_points(dict(enumerate(seeds.shown())), num_done):
            seeds.train(list(points))
            num_done += 1
        expected = expected_means(seeds.shown())
        return int(np.argmax(expected))


Way = MeanOfSeeds | RaceOfLeaders

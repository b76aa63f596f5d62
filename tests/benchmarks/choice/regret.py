"""What is lost by each way to choose a setting, in the tasks that were trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tests.benchmarks.choice.rules import SCORES, MeanOfSeeds, RaceOfLeaders, Seeds, Way
from tests.benchmarks.choice.trained import Floats, Task

BASELINE = "last training return"


@dataclass(frozen=True)
class Rule:
    """A score of a training, and a way to spend trainings on it."""

    score: str
    way: Way
    told: str


RULES: tuple[Rule, ...] = (
    *(
        Rule(score, MeanOfSeeds(num_seeds), f"{num_seeds:g} seed{'s' * (num_seeds > 1)} a setting")
        for score, seeds in {
            "best evaluation, as before": (1, 3),
            BASELINE: (1, 1.5, 3),
            "last evaluation": (1, 3),
            "area": (1, 3),
            "final": (1, 1.5, 3),
        }.items()
        for num_seeds in seeds
    ),
    Rule("final", RaceOfLeaders(5, 3), "launch: race of 5, within half of the search"),
    Rule("final", RaceOfLeaders(5, 5), "replicate: race of 5, at most 5 seeds"),
)
DEFAULT, AT_EQUAL_COST = RULES[-2], next(r for r in RULES if r.score == BASELINE and r.way == MeanOfSeeds(1.5))


@dataclass(frozen=True)
class Regret:
    """The regret of one rule in one task."""

    mean: float
    """What is lost to the best setting, as a share of best minus median."""
    standard_error: float
    num_trainings: float


def regrets(task: Task, num_draws: int, *, rules: tuple[Rule, ...] = RULES) -> list[Regret]:
    """Return the regret of each rule, over draws of which seeds are seen; all rules have the same draws.

    A chosen setting is worth its mean last evaluation on the seeds that were not seen; best and median are those of the
    means over all seeds.
    """
    truth = task.evaluations[:, :, -1]
    means = truth.mean(axis=1)
    best, median = float(means.max()), float(np.median(means))
    scores: Mapping[str, Floats] = {name: _known(score(task)) for name, score in SCORES.items()}
    found = []
    for rule in rules:
        lost, cost = [], []
        for draw in range(num_draws):
            seeds = Seeds(scores[rule.score], np.random.default_rng([0, draw]))
            chosen = rule.way.choose(seeds)
            lost.append((best - float(truth[chosen, seeds.unseen(chosen)].mean())) / (best - median))
            cost.append(int(seeds.num_used.sum()))
        found.append(Regret(float(np.mean(lost)), float(np.std(lost) / num_draws**0.5), float(np.mean(cost))))
    return found


def _known(scores: Floats) -> Floats:
    """Return the scores, where a training that showed nothing has the worst of all."""
    return np.where(np.isfinite(scores), scores, np.nanmin(scores))

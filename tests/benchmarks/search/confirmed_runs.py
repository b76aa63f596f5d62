"""Runs as a sweep makes them by default: points of one seed each, then more seeds for the leading ones (`confirm`).

They may make as many trainings as the other runs, 96: 82 points, and at most 14 trainings in the race of the leading
five. What is named is the setting of the highest expected mean over its seeds, as `tune-jobs best` names it.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

from analysis.objectives import expected_means
from analysis.racing import Race, race_within
from tests.benchmarks.search.runs import Run, mean_or_worst
from tests.benchmarks.search.tasks import TEST_SEEDS, TUNING_SEEDS, Task
from tests.benchmarks.search.trainings import Wanted
from tune_jobs.plan.points import point_hyperparams
from tune_jobs.search.history import KnownPoint
from tune_jobs.search.proposal import next_point
from tune_jobs.spec.sections import ConfirmSpec

CONFIRMED = {"random-confirm": "random", "gp-confirm": "gp"}
"""The methods, by what chooses the points."""
_CONFIRM = ConfirmSpec()
NUM_TRAININGS = 32 * len(TUNING_SEEDS)
NUM_POINTS = NUM_TRAININGS - Race(tuple(range(_CONFIRM.top)), _CONFIRM.seeds).max_trainings
_AT_ONCE = NUM_POINTS // 10
"""How many points are tried at once where a model chooses them: a tenth, as in packs (decision 40)."""


def run(task: Task, method: str, number: int) -> Generator[list[Wanted], list[float | None], Run]:
    """Run one optimiser; the arguments are those of `runs.run`."""
    spec, search = task.spec, CONFIRMED[method]
    known: list[KnownPoint] = []

    def next_points(count: int) -> list[dict[str, Any]]:
        points: list[dict[str, Any]] = []
        for index in range(len(known), min(len(known) + count, NUM_POINTS)):
            running = [KnownPoint(point, is_running=True) for point in points]
            points.append(
                next_point(
                    search, spec.space, [*known, *running], index, seed=number,
                    num_startup_trials=spec.search.num_startup_trials,
                    check=lambda point: point_hyperparams(spec, point, None),
                )
            )  # fmt: skip
        return points

    while len(known) < NUM_POINTS:
        # What does not depend on results is trained side by side.
        num_drawn = NUM_POINTS if search == "random" else spec.search.num_startup_trials
        points = next_points(_AT_ONCE if known else num_drawn)
        first = seed_of(number, len(known))
        returns = yield [Wanted(point, first + place) for place, point in enumerate(points)]
        known += [KnownPoint(point, scores=(score,)) for point, score in zip(points, returns, strict=True)]
    points = [dict(item.point) for item in known]
    returns_of = [list(item.scores) for item in known]
    race = race_within(
        ranked(returns_of), top=_CONFIRM.top, num_seeds=_CONFIRM.seeds, max_trainings=NUM_TRAININGS - NUM_POINTS
    )
    assert race is not None
    for num_done in range(len(race.rounds)):
        scores = finite_scores(returns_of)
        chosen = race.next_points({index: scores[index] for index in race.contenders}, num_done)
        if not chosen:
            break
        wanted = []
        num_seeds = {index: len(returns_of[index]) for index in chosen}
        for index in chosen:
            wanted.append(Wanted(points[index], seed_of(number, index, num_seeds[index])))
            num_seeds[index] += 1
        returns = yield wanted
        for index, score in zip(chosen, returns, strict=True):
            returns_of[index].append(score)
    best = points[ranked(returns_of)[0]]
    test = yield [Wanted(best, seed) for seed in TEST_SEEDS]
    return Run(tuple(map(mean_or_worst, returns_of)), best, mean_or_worst(test))


def seed_of(number: int, index: int, seed_index: int = 0) -> int:
    """Return the training seed of a point's trial, which no other trial of any run has, as in sweeps.

    With one seed for all, luck would be the same in neighbouring points: a model finds what goes well with that seed.
    On MountainCarContinuous what `gp-confirm` named so came to 36 on the test seeds, and random draws to 97.

    Args:
        number: The run's number.
        index: The point's index.
        seed_index: The number of the trial among those of the point.
    """
    return 10_000 * (number + 1) + 100 * seed_index + index


def finite_scores(returns: list[list[float | None]]) -> list[tuple[float, ...]]:
    """Return the returns of each point's seeds; one that failed has the worst of all, as in a sweep."""
    known = [value for seeds in returns for value in seeds if value is not None]
    worst = min(known, default=0.0)
    return [tuple(worst if value is None else value for value in seeds) for seeds in returns]


def ranked(returns: list[list[float | None]]) -> list[int]:
    """Return points by their expected means, the best first; of equals the first, and no failed one before another."""
    scores = finite_scores(returns)
    expected = expected_means(scores)

    def order(index: int) -> tuple[float, float, int, int]:
        return -expected[index], -sum(scores[index]) / len(scores[index]), returns[index].count(None), index

    return sorted(range(len(returns)), key=order)

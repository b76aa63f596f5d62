"""The made-up tasks by which search methods are compared (`tests.benchmarks.simulated_search`)."""

import numpy as np
import pytest

from tests.benchmarks.simulated_search import TASKS, Task, worth_of
from tune_jobs.spec.draws import draw_point


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("run", [0, 5, 9])
def test_no_point_is_worth_more_than_the_best_place(name: str, run: int) -> None:
    """Where the best lr depends on a value of a list, too; shares of the way there would else be over 1."""
    task, rng = Task(name, run), np.random.default_rng(1)
    low, high = task.ends()
    points = [draw_point(task.space, index, 7) for index in range(500)]
    worth = [worth_of(task.scores(point, rng, 20)) for point in points]
    leading = [points[index] for index in np.argsort(worth)[-5:]]
    # Of as many trials as the best place: the difference of two means of theirs is below a thirtieth of the range.
    best = max(worth_of(task.scores(point, rng, 2_000)) for point in leading)
    assert low < high
    assert best <= high + (high - low) / 30

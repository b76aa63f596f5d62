"""Search of a front: score and cost as the one number that a method is told."""

import math
from typing import Any

import numpy as np
import pytest
from test_search_methods import each_method, record

from tests.narrowing import present
from tune_jobs.search.history import KnownPoint, known_points
from tune_jobs.search.proposal import propose_point
from tune_jobs.search.two_objectives import weighed
from tune_jobs.spec.draws import draw_point
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec

LENGTH = "stop.num_env_steps"
SPACE = {"lr": {"loguniform": [1e-5, 1e-1]}, "gamma": {"uniform": [0.8, 1.0]}, LENGTH: {"lograndint": [5_000, 100_000]}}


def spec_of(method: str, objective: Any, seed: int = 0) -> SweepSpec:
    search = {"type": method, "num_startup_trials": 8}
    base = {"env": "CartPole-v1", "algorithm": "ppo", "space": SPACE, "num_samples": 30, "objective": objective}
    return load_spec({**base, "search": search, "seed": seed})


def score_of(point: dict[str, Any]) -> float:
    """Saturates with the length, soonest with a learning rate of 1e-3 and a gamma of 0.95."""
    off = abs(math.log10(point["lr"]) + 3) + 10 * abs(point["gamma"] - 0.95)
    return 500 * (1 - math.exp(-point[LENGTH] / 8_000 * math.exp(-off)))


def share_of_area(points: list[dict[str, Any]]) -> float:
    """Return the share of the area of score and log cost that is below the front."""
    costs = np.exp(np.linspace(math.log(5_000), math.log(100_000), 200))
    return (
        float(np.mean([max((score_of(p) for p in points if p[LENGTH] <= cost), default=0.0) for cost in costs])) / 500
    )


def searched(method: str, objective: Any, seed: int) -> list[dict[str, Any]]:
    spec, records = spec_of(method, objective, seed), list[Any]()
    for index in range(spec.num_samples):
        point = propose_point(spec, records, index, lambda _: None)
        records.append(record(index, point, score_of(point), steps=point[LENGTH]))
    return [item.point for item in records]


@each_method
def test_a_method_that_is_told_of_the_cost_finds_more_of_the_front(method: str) -> None:
    alone = [searched(method, "final", seed) for seed in range(2)]
    both = [searched(method, ["return", "env_steps"], seed) for seed in range(2)]
    # Over 10 seeds of 40 points it is 0.08 (forest) to 0.18 (gp), with a standard error of 0.02.
    assert np.mean([*map(share_of_area, both)]) > np.mean([*map(share_of_area, alone)])
    assert np.median([point[LENGTH] for tried in both for point in tried]) < np.median(
        [point[LENGTH] for tried in alone for point in tried]
    )


def numbers(known: list[KnownPoint], index: int = 0) -> list[float]:
    return [present(item.score) for item in weighed(known, index, seed=0)]


def test_better_and_cheaper_is_always_more() -> None:
    known = [
        KnownPoint({"x": 0}, (1.0, 2.0), env_steps=(500, 700)),
        KnownPoint({"x": 1}, (3.0,), env_steps=(400,)),
        KnownPoint({"x": 2}, (9.0, None), env_steps=(300, 900)),
        KnownPoint({"x": 3}, (9.0,), env_steps=(2_000,), level=2),
    ]
    orders = set()
    for index in range(30):
        made = weighed(known, index, seed=0)
        assert present(made[1].score) > present(made[0].score)
        assert (made[2].scores[1], made[2].score) == (None, None)  # a failed seed stays one
        assert (made[3].point, made[3].level, made[3].env_steps) == ({"x": 3}, 2, (2_000,))
        orders.add(present(made[3].score) > present(made[1].score))
    assert orders == {True, False}  # which of two on the front is more depends on the weight
    assert numbers(known[:2], 5) == numbers(known[:2], 5) != numbers(known[:2], 6)


@pytest.mark.parametrize("scores", [(None,), (), (1.7e308, -1.7e308), (5.0, 5.0)])
def test_scores_of_any_size_or_none_are_weighed(scores: tuple[float | None, ...]) -> None:
    (made,) = weighed([KnownPoint({}, scores, env_steps=(1,) * len(scores))], 0, seed=0)
    assert [score is None for score in made.scores] == [score is None for score in scores]
    assert all(math.isfinite(score) for score in made.scores if score is not None)


def test_points_are_known_with_what_their_trainings_took() -> None:
    spec = spec_of("random", ["return", "env_steps"])
    point = {"lr": 1e-3, "gamma": 0.9, LENGTH: 50_000}
    records = [
        record(0, point, 3.0, steps=50_176), record(1, point, 1.0, steps=9_000, status="stopped", point_index=0),
        record(2, point, status="failed", steps=10, point_index=0),
    ]  # fmt: skip
    (known,) = known_points(spec, records)
    assert known.env_steps == (50_176, 50_000, 50_000)
    assert len(known.scores) == 3


def test_one_training_that_diverged_leaves_scores_their_say() -> None:
    """Beside minus a million all others lost nothing, and every weight asked for the cheapest."""
    rng = np.random.default_rng(0)
    known = [
        KnownPoint({"x": at}, (float(500 * rng.random()),), env_steps=(int(rng.integers(5_000, 100_000)),))
        for at in range(30)
    ]
    cheapest = min(range(30), key=lambda at: known[at].env_steps)
    for others in ([], [KnownPoint({"x": 30}, (-1e6,), env_steps=(50_000,))]):
        wins = [int(np.argmax(numbers([*known, *others], index))) for index in range(100)]
        assert 0 < wins.count(cheapest) < 50
        assert len(set(wins)) >= 3
        # What diverged is the last of all where the score counts.
        assert any(int(np.argmin(numbers([*known, *others], index))) == 30 for index in range(100)) == bool(others)


@each_method
def test_as_long_as_nothing_is_learnt_the_search_does_not_go_for_the_shortest_trainings(method: str) -> None:
    spec = spec_of(method, ["return", "env_steps"])
    points = [draw_point(spec.space, index, spec.seed) for index in range(20)]
    records = [record(at, point, -200.0, steps=point[LENGTH]) for at, point in enumerate(points)]
    assert propose_point(spec, records, 20, lambda _: None) == draw_point(spec.space, 20, spec.seed)
    better = [*records[:19], record(19, points[19], -150.0, steps=points[19][LENGTH])]
    assert propose_point(spec, better, 20, lambda _: None) != draw_point(spec.space, 20, spec.seed)


@each_method
def test_where_no_length_is_searched_equal_scores_are_told_apart_by_what_they_took(method: str) -> None:
    """A training that is solved ends early: of those that reach the same, the one that got there first is better."""
    whole = spec_of(method, ["return", "env_steps"])
    spec = whole.model_copy(update={"space": {name: each for name, each in whole.space.items() if name != LENGTH}})
    points = [draw_point(spec.space, index, spec.seed) for index in range(20)]
    records = [record(at, point, 500.0, steps=5_000 + 1_000 * at) for at, point in enumerate(points)]
    assert propose_point(spec, records, 20, lambda _: None) != draw_point(spec.space, 20, spec.seed)

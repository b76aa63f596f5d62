"""No point is drawn twice while a space has others."""

from collections import Counter
from typing import Any

import pytest
from spec_errors import MINIMAL

from analysis.records import PriorPointRecord, PriorRecord
from policies import random_streams
from tests.narrowing import present
from tune_jobs.search.history import KnownPoint
from tune_jobs.search.points import planned_points
from tune_jobs.search.prior import with_prior
from tune_jobs.search.proposal import next_point
from tune_jobs.spec.domains import Domain
from tune_jobs.spec.draws import draw_first_points, draw_point, draw_points
from tune_jobs.spec.file import load_spec

LISTS = {
    "lr": {"choice": [1e-4, 3e-4, 1e-3, 3e-3]},
    "activation": {"choice": ["relu", "tanh"]},
    "hidden_sizes": {"choice": [[16], [32], [64, 64]]},
}
NUM_POINTS = 24


def space_of(space: dict[str, Any], **fields: Any) -> dict[str, Domain]:
    return dict(load_spec({**MINIMAL, "space": space, **fields}).space)


def counts(points: list[dict[str, Any]]) -> Counter[str]:
    return Counter(map(repr, points))


@pytest.mark.parametrize("seed", range(5))
def test_all_points_of_lists_come_before_any_comes_again(seed: int) -> None:
    points = draw_points(space_of(LISTS), 2 * NUM_POINTS, seed)
    assert set(counts(points[:NUM_POINTS]).values()) == {1}
    assert list(counts(points).values()) == [2] * NUM_POINTS
    # Independent draws, as other tools make them, would have repeated some.
    independent = [draw_point(space_of(LISTS), index, seed) for index in range(NUM_POINTS)]
    assert len(counts(independent)) < NUM_POINTS
    assert points[:NUM_POINTS] == draw_first_points(space_of(LISTS), NUM_POINTS, seed)


def test_more_samples_append_points_and_change_none() -> None:
    space = space_of(LISTS)
    points = draw_points(space, 60, 3)
    assert all(draw_points(space, number, 3) == points[:number] for number in (1, 7, 20, 24, 25, 50))


def test_what_an_index_draws_first_is_kept_if_it_is_new() -> None:
    space = space_of(LISTS)
    points = draw_points(space, 20, 0)
    drawn = [draw_point(space, index, 0) for index in range(20)]
    assert [point for index, point in enumerate(drawn) if point not in points[:index]] == [
        point for index, point in enumerate(points) if point == drawn[index]
    ]


def test_each_combination_of_grids_has_different_random_values() -> None:
    space = space_of({**LISTS, "lr": {"grid": [1e-4, 1e-3]}})
    points = draw_points(space, 6, 0)
    assert len(points) == 12 == len(counts(points))
    assert [point["lr"] for point in points] == [1e-4, 1e-3] * 6


def test_whole_numbers_and_steps_repeat_no_earlier_than_lists() -> None:
    space = space_of({"num_envs": {"randint": [1, 5]}, "clip_param": {"quniform": [0.1, 0.3, 0.1]}})
    assert set(counts(draw_points(space, 12, 0)).values()) == {1}


def test_a_point_without_what_does_not_act_in_it_is_one_point() -> None:
    space = space_of(
        {
            "replay": {"choice": ["uniform", "prioritized"]},
            "prioritized_alpha": {"uniform": [0.1, 0.9], "when": {"replay": "prioritized"}},
        },
        algorithm="dqn",
    )
    points = draw_points(space, 12, 0)
    assert sum(point == {"replay": "uniform"} for point in points) == 1
    assert len(counts(points)) == 12


def test_where_nothing_random_acts_a_combination_is_repeated() -> None:
    """Nothing of it could be drawn again, and that is not tried."""
    when = {"when": {"replay": "prioritized"}}
    space = space_of(
        {"replay": {"grid": ["uniform", "prioritized"]}, "prioritized_alpha": {"choice": [0.2, 0.4], **when}},
        algorithm="dqn",
    )
    points = draw_points(space, 4, 0)
    assert points[::2] == [{"replay": "uniform"}] * 4
    assert sorted(point["prioritized_alpha"] for point in points[1::2]) == [0.2, 0.2, 0.4, 0.4]
    assert points[1] != points[3]


def test_a_combination_with_few_points_lets_no_other_repeat_its_own() -> None:
    when = {"when": {"replay": "prioritized"}}
    space = space_of(
        {
            "replay": {"grid": ["uniform", "prioritized"]},
            "prioritized_alpha": {"choice": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], **when},
            "double_q": {"choice": [True, False]},
        },
        algorithm="dqn",
    )
    points = draw_points(space, 12, 0)
    assert sorted(counts(points[::2]).values()) == [6, 6]
    assert set(counts(points[1::2]).values()) == {1}


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("method", ["random", "gp", "forest"])
def test_search_methods_try_all_points_of_lists_before_any_again(method: str, seed: int) -> None:
    space, known = space_of(LISTS), list[KnownPoint]()
    for index in range(NUM_POINTS):
        point = next_point(method, space, known, index, seed=seed)
        known.append(KnownPoint(point, scores=(float(point["lr"] > 5e-4) + 0.1 * (index % 3),)))
    assert set(counts([dict(item.point) for item in known]).values()) == {1}
    assert next_point(method, space, known, NUM_POINTS, seed=seed) in [item.point for item in known]


def test_the_first_points_of_a_model_are_different() -> None:
    search = {"type": "gp", "num_startup_trials": 12}
    lists = {**LISTS, "lr": {"grid": [1e-4, 1e-3]}}
    spec = load_spec({**MINIMAL, "space": lists, "num_samples": 14, "search": search})
    points = planned_points(spec)
    assert points[12:] == [None, None]
    assert len({repr(point) for point in points[:12]}) == 12


def score(point: dict[str, Any]) -> float:
    return -3.0 * abs([1e-4, 3e-4, 1e-3, 3e-3].index(point["lr"]) - 2) + float(point["activation"] == "tanh")


def prior_of_all_points() -> list[PriorRecord]:
    """An earlier sweep that had every point of the space, the worst first."""
    points = sorted(draw_points(space_of(LISTS), NUM_POINTS, 9), key=score)
    items = [PriorPointRecord(point=point, share=(place + 0.5) / NUM_POINTS) for place, point in enumerate(points)]
    return [PriorRecord(sweep="first", env_id="CartPole-v1", points=tuple(items))]


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(("method", "num_random"), [("gp", 10), ("gp", 40), ("forest", 10)])
def test_points_of_an_earlier_sweep_are_none_that_this_one_tried(method: str, num_random: int, seed: int) -> None:
    """None comes twice, though the earlier sweep had all of them, and the model begins with what was best there."""
    space, prior, known = space_of(LISTS), prior_of_all_points(), list[KnownPoint]()
    for index in range(12):
        told = with_prior(known, prior)
        point = next_point(method, space, told, index, seed=seed, num_startup_trials=num_random)
        known.append(KnownPoint(point, scores=(score(point),)))
    assert set(counts([dict(item.point) for item in known]).values()) == {1}
    if num_random < NUM_POINTS:
        assert max(present(item.score) for item in known[:3]) == score(prior[0].points[-1].point)


def test_every_fifth_point_of_a_forest_is_random_though_an_earlier_sweep_had_it() -> None:
    space, told = space_of(LISTS), with_prior([], prior_of_all_points())
    indices = [index for index in range(30) if random_streams.model_draws(0, index).random() < 0.2]
    assert len(indices) > 2
    for index in indices:
        assert next_point("forest", space, told, index, seed=0) == draw_point(space, index, 0)

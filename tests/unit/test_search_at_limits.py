"""Search methods where little is known, where rungs are reached exactly, and what they must leave as it was."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from test_search_methods import make_spec, record, valley

from policies.errors import SpecError
from tune_jobs.search import gaussian_process, gp
from tune_jobs.search.coordinates import Cube
from tune_jobs.search.fidelity import Lengths
from tune_jobs.search.history import KnownPoint, known_points
from tune_jobs.search.proposal import next_point
from tune_jobs.search.two_objectives import weighed
from tune_jobs.search.warped import warped
from tune_jobs.spec.domains import Domain
from tune_jobs.spec.draws import draw_point
from tune_jobs.spec.file import load_spec

SPACE = make_spec().space


def tried(number: int, **fields: Any) -> list[KnownPoint]:
    points = [draw_point(SPACE, index, 0) for index in range(number)]
    return [KnownPoint(point, (valley(point),) if not fields else (), **fields) for point in points]


@pytest.mark.parametrize("method", ["gp", "forest", "tpe"])
def test_points_that_still_run_are_not_enough_for_a_model(method: str) -> None:
    """As where more places are free than the search begins with random points."""
    if method == "forest":
        pytest.importorskip("sklearn")
    elif method == "tpe":
        pytest.importorskip("optuna")
    for known in (tried(8, is_running=True), [*tried(3), *tried(12, is_running=True)[3:]]):
        found = next_point(method, SPACE, known, len(known), seed=0, num_startup_trials=4)
        assert found == draw_point(SPACE, len(known), 0)


def test_the_forest_draws_a_fifth_and_where_that_goes_not_together_its_trees_are_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("sklearn")
    from tune_jobs.search import forest

    def model(*_: Any, **__: Any) -> dict[str, Any]:
        return {"lr": 0.5, "activation": "none"}

    monkeypatch.setattr(forest, "best_point", model)
    known = tried(10)
    found = [next_point("forest", SPACE, known, index, seed=0) for index in range(10, 110)]
    drawn = [index for index, point in enumerate(found, start=10) if point["activation"] != "none"]
    assert 10 <= len(drawn) <= 30
    assert [found[index - 10] for index in drawn] == [draw_point(SPACE, index, 0) for index in drawn]

    def refuses(point: dict[str, Any]) -> None:
        raise SpecError("These do not go together.")

    assert next_point("forest", SPACE, known, drawn[0], seed=0, check=refuses) == model()


def test_settings_of_the_process_are_found_anew_where_points_have_grown_by_a_tenth(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("scipy")
    fitted: list[int] = []
    fit = gaussian_process.fit

    def counted(observed: Any, *arguments: Any, **options: Any) -> Any:
        fitted.append(len(observed.means))
        return fit(observed, *arguments, **options)

    monkeypatch.setattr(gp, "fit", counted)
    gp._fitted.cache_clear()
    known = tried(110)
    for number in range(100, 110):
        gp._settings(Cube(SPACE), known[:number], Lengths.among(known))
    assert fitted == [100]
    gp._settings(Cube(SPACE), known, Lengths.among(known))
    assert len(fitted) == 2


@pytest.mark.parametrize(("factor", "rungs"), [(3, 5), (10, 3), (2, 3), (4, 2)])
def test_a_rung_that_is_reached_exactly_is_reached(factor: int, rungs: int) -> None:
    scheduler = {"type": "asha", "grace_env_steps": 100, "reduction_factor": factor}
    spec = load_spec(
        {
            "env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"loguniform": [1e-5, 1e-1]}},
            "scheduler": scheduler, "stop": {"num_env_steps": 200_000}, "seeds_per_point": 2,
        }
    )  # fmt: skip
    ended = [
        record(index, {"lr": 1e-3}, 1.0, status="stopped", point_index=0, steps=100 * factor**rung)
        for index, rung in enumerate((rungs, rungs + 1))
    ]
    # Of two seeds, the one that got less far.
    assert [point.level for point in known_points(spec, ended)] == [rungs]
    early = record(0, {"lr": 1e-3}, 1.0, status="stopped", steps=60)
    assert [point.level for point in known_points(spec, [early])] == [0]


def test_scores_at_both_ends_of_what_a_float_can_be_are_told_apart() -> None:
    known = [KnownPoint({}, (score,), env_steps=(1,)) for score in (1.7e308, 0.0, -1.7e308)]
    found = [item.score for item in weighed(known, 0, seed=0)]
    assert all(score is not None and np.isfinite(score) for score in found)
    assert found[0] > found[1] > found[2]  # type: ignore[operator]


WIDE = [
    [(-1.7e308,), (1.7e308,), (-1.6e308,), (1.6e308,), (-1.5e308,)],
    [(1.7e308, 1.7e308), (-1.7e308, -1.7e308), (3.0, 4.0), (-5.0, 1.0), (0.0, 2.0)],
]


@pytest.mark.parametrize("scores", WIDE)
def test_a_model_is_told_finite_scores_in_their_order_where_sums_and_differences_are_not(
    scores: list[tuple[float, ...]],
) -> None:
    points = [draw_point(SPACE, index, 0) for index in range(len(scores))]
    known = [KnownPoint(point, each) for point, each in zip(points, scores, strict=True)]
    means = [each[0] / 2 + each[-1] / 2 for each in scores]
    assert [item.score for item in known] == means
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        told = warped(known)
    assert all(np.isfinite(values).all() for values in told)
    assert np.argsort(told.scores).tolist() == np.argsort(means).tolist()


@pytest.mark.parametrize("scores", WIDE)
def test_the_forest_proposes_a_point_after_scores_at_both_ends(scores: list[tuple[float, ...]]) -> None:
    pytest.importorskip("sklearn")
    points = [draw_point(SPACE, index, 0) for index in range(len(scores))]
    known = [KnownPoint(point, each) for point, each in zip(points, scores, strict=True)]
    found = [next_point("forest", SPACE, known, index, seed=0, num_startup_trials=4) for index in range(5, 10)]
    assert all(point.keys() == SPACE.keys() for point in found)


def test_the_means_of_ordinary_scores_are_their_sum_by_their_number_to_the_bit() -> None:
    seeds = (0.1, 0.1, 0.1)
    assert KnownPoint({}, seeds).score == sum(seeds) / 3 != sum(score / 3 for score in seeds)


def test_the_words_of_optuna_are_as_loud_as_before() -> None:
    optuna = pytest.importorskip("optuna")
    before = optuna.logging.get_verbosity()
    try:
        for level in (optuna.logging.INFO, optuna.logging.WARNING):
            optuna.logging.set_verbosity(level)
            next_point("tpe", SPACE, tried(10), 10, seed=0)
            assert optuna.logging.get_verbosity() == level
    finally:
        optuna.logging.set_verbosity(before)


@pytest.mark.parametrize("number", [2, 3, 7, 29, 49, 98])
def test_a_value_of_a_list_is_in_the_middle_of_its_part(number: int) -> None:
    values = list(range(number))
    domain = load_spec(
        {"env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"choice": [0.001 * (1 + v) for v in values]}}}
    ).space["lr"]
    space: dict[str, Domain] = {"lr": domain}
    cube = Cube(space)
    for value in values:
        point = {"lr": 0.001 * (1 + value)}
        (place,) = cube.units([point])
        for step in (-0.45, 0.0, 0.45):
            assert cube.point(place + step / number) == point


def test_a_drawn_point_of_the_forest_that_was_tried_is_not_tried_again_where_something_does_not_act() -> None:
    """What does not act in a point is drawn too, and makes no other point of it."""
    pytest.importorskip("sklearn")
    space: dict[str, Any] = load_spec(
        {
            "env": "CartPole-v1", "algorithm": "dqn", "num_samples": 40,
            "space": {
                "replay": {"choice": ["uniform", "prioritized"]},
                "n_step": {"choice": [1, 2, 3]},
                "prioritized_alpha": {"uniform": [0.1, 1.0], "when": {"replay": "prioritized"}},
                "hidden_sizes": {"layers": {"number": [1, 2], "sizes": [32, 64]}},
            },
        }
    ).space  # fmt: skip
    known: list[KnownPoint] = []
    for index in range(20):
        point = next_point("forest", space, known, index, seed=4)
        assert all(item.point != point for item in known), index
        known.append(KnownPoint(point, (float(point["n_step"] - (point["replay"] == "prioritized")),)))


def test_settings_are_found_anew_as_seldom_at_thousands_of_points() -> None:
    """Finding them takes longer than all else, and was due at each tenth point, however many there were."""
    found = [gp._by_tenths(number) for number in range(10, 5_001)]
    assert all(number * 0.9 < each <= number for number, each in enumerate(found, start=10))
    assert found == sorted(found[:90]) + sorted(found[90:])
    assert len(set(found[990:])) <= 18  # 1.1 ** 17 is 5

"""The Gaussian process, what it is told, and the numbers that values are for it."""

import json
import math
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from tune_jobs.search import gaussian_process
from tune_jobs.search.asking import Question
from tune_jobs.search.candidates import _settled, _steps
from tune_jobs.search.coordinates import Cube
from tune_jobs.search.gaussian_process import Observed, Posterior, Settings, _expected, _loss, _squares_by_group, fit
from tune_jobs.search.history import KnownPoint
from tune_jobs.search.improvement import log_expected_improvement
from tune_jobs.search.parts import Parts
from tune_jobs.search.proposal import next_point
from tune_jobs.search.warped import observed, warped
from tune_jobs.spec.domains import DOMAIN_KINDS, Domain
from tune_jobs.spec.draws import draw_point

SPACE: dict[str, Domain] = {
    name: TypeAdapter(Domain).validate_python(domain)
    for name, domain in {
        "uniform": {"uniform": [-1, 2]},
        "loguniform": {"loguniform": [1e-5, 1e-1]},
        "quniform": {"quniform": [0.9, 0.99, 0.03]},
        "qloguniform": {"qloguniform": [0.01, 0.5, 0.01]},
        "randint": {"randint": [0, 5]},
        "lograndint": {"lograndint": [1, 9]},
        "qrandint": {"qrandint": [512, 1024, 128]},
        "qlograndint": {"qlograndint": [64, 512, 64]},
        "grid": {"grid": [[8], [16, 16], [8, 8]]},
        "choice": {"choice": [0.1, 10, 1]},
        "two": {"choice": [True, False]},
        "one": {"choice": ["tanh"]},
        "one_step": {"qrandint": [60, 100, 64]},
        "power_of_two": {"power_of_two": [16, 256]},
        "one_minus_loguniform": {"one_minus_loguniform": [0.9, 0.9999]},
    }.items()
}
CUBE = Cube(SPACE)


def drawn(number: int) -> list[dict[str, Any]]:
    return [draw_point(SPACE, index, 0) for index in range(number)]


# -- values and numbers


def test_every_point_is_a_place_in_the_cube_and_that_place_is_the_point() -> None:
    # Layers are lists and ranges for models (`tune_jobs.search.parts`).
    assert {domain.kind for domain in SPACE.values()} == {*DOMAIN_KINDS} - {"layers"}
    points = drawn(200)
    units = CUBE.units(points)
    assert ((units >= 0) & (units <= 1)).all()
    for point, place in zip(points, units, strict=True):
        back = CUBE.point(place)
        for name in ("uniform", "loguniform", "one_minus_loguniform"):
            assert back.pop(name) == pytest.approx(point.pop(name))
        assert json.dumps(back) == json.dumps(point)


def test_all_values_are_reached_as_often_as_they_are_drawn() -> None:
    rng = np.random.default_rng(0)
    places = [CUBE.point(place) for place in rng.random((4_000, CUBE.num_sides))]
    random = drawn(4_000)
    for name, domain in SPACE.items():
        if name.endswith("uniform"):  # their first and last steps are narrower
            continue
        ours, theirs = ([json.dumps(point[name]) for point in points] for points in (places, random))
        assert set(ours) == set(theirs)
        for value in set(theirs):
            assert ours.count(value) == pytest.approx(theirs.count(value), abs=180), (domain, value)


def test_columns_go_from_0_to_1_and_values_in_no_order_are_as_far_from_each_other_as_ends() -> None:
    columns = CUBE.columns(CUBE.units(drawn(300)))
    assert columns.min() == 0
    assert columns.max() == 1
    grid = columns[:, CUBE.group_of_column == list(SPACE).index("grid")]
    distances = np.sqrt(((grid[:, None] - grid[None, :]) ** 2).sum(-1))
    assert sorted({round(float(distance), 9) for distance in distances.ravel()}) == [0.0, 1.0]
    # Numbers of a list are in their order, whatever the list's is.
    lists = Cube({"choice": SPACE["choice"]})
    assert lists.columns(lists.units([{"choice": value} for value in (0.1, 1, 10)])).ravel().tolist() == [0.0, 0.5, 1.0]


def test_a_name_that_a_point_lacks_is_in_the_middle() -> None:
    (place,) = CUBE.units([{"lograndint": 1}])
    others = np.arange(CUBE.num_sides) != list(SPACE).index("lograndint")
    assert (place[others] == 0.5).all()
    assert place[~others] < 0.5


# -- what the model is told


def known(*scores: tuple[float | None, ...], level: int | None = None) -> list[KnownPoint]:
    return [KnownPoint({"x": 0.5}, each, level=level) for each in scores]


@pytest.mark.parametrize("scale", [1e-300, 1.0, 1e300])
def test_no_scale_of_returns_matters_and_those_that_diverged_or_failed_are_worst_without_a_distance(
    scale: float,
) -> None:
    usual = warped(known((1,), (2,), (3,), (4,), (8,))).scores
    scaled = warped(known(*((score * scale,) for score in (1, 2, 3, 4, 8)))).scores
    assert scaled == pytest.approx(usual)
    assert (np.diff(usual) > 0).all()
    assert usual.mean() == pytest.approx(0)
    assert usual.std() == pytest.approx(1)
    for bad in (-1e300, None):
        assert warped(known((bad,), (2,), (3,), (4,), (8,))).scores == pytest.approx(usual)
    # One setting that is far better than all others stands out, but does not make these equal.
    high = warped(known((1,), (2,), (3,), (4,), (1e6,))).scores
    assert high[3] - high[2] > 0.05
    assert np.isfinite(high).all()


def test_equal_scores_are_equal_and_what_was_ended_early_is_worse_than_what_was_not() -> None:
    assert warped(known((5,), (5,), (5,))).scores.tolist() == [0.0, 0.0, 0.0]
    points = [
        *known((9.0, None, None), (9.0, None)), *known((100.0,), level=0), *known((90.0,), level=1),
        *known((95.0,), level=1), *known((1.0,), (2.0, 2.0), (2.0,)),
    ]  # fmt: skip
    scores = warped(points).scores
    assert (np.diff(scores[:7]) > 0).all()
    assert scores[6] == scores[7]


def test_points_are_in_the_order_of_their_means_and_seeds_tell_how_far_these_can_be_trusted() -> None:
    points = known((1.0, 1.0), (1.1, 0.9), (5.0, -9.0), (-3.0, -3.0), (0.0, 2.1), (None, 7.0), (7.0,))
    scores, counts, spreads = warped(points)
    assert np.argsort(scores, kind="stable").tolist() == [5, 3, 2, 0, 1, 4, 6]
    assert scores[0] == scores[1]
    assert counts.tolist() == [2, 2, 2, 2, 2, 1, 1]
    assert spreads[0] == spreads[3] == spreads[5] == spreads[6] == 0
    assert 0 < spreads[1] < spreads[4] < spreads[2]


def test_the_model_is_given_the_best_the_newest_and_some_others_and_no_point_that_runs() -> None:
    cube = Cube({"x": SPACE["uniform"]})
    points = [KnownPoint({"x": index / 1000}, (float(-abs(index - 200)),)) for index in range(1000)]
    seen, units = observed(cube, [*points, KnownPoint({"x": 1.9}, (1e9,), is_running=True)], 60)
    given = {round(cube.point(place)["x"] * 1000) for place in units}
    assert len(given) == len(seen.means) == 60
    assert set(range(191, 210)) <= given
    assert set(range(980, 1000)) <= given
    assert min(given) == 0
    assert max(np.diff(sorted(given))) < 100


# -- the process


def observed_at_random(number: int, rng: np.random.Generator) -> Observed:
    columns = rng.random((number, 4))
    return Observed(columns, rng.normal(size=number), rng.integers(1, 4, number).astype(float), 3.3)


GROUPS = np.array([0, 1, 1, 2])


def test_the_gradient_by_which_settings_are_found_is_that_of_their_likelihood() -> None:
    rng = np.random.default_rng(0)
    seen = observed_at_random(20, rng)
    squares, (expected, width) = _squares_by_group(seen.columns, GROUPS, 3), _expected(3)
    at = expected + 0.3 * rng.normal(size=5)
    _, gradient = _loss(at, seen, squares, expected, width)
    for index, slope in enumerate(gradient):
        step = np.eye(5)[index] * 1e-5
        more, less = (_loss(at + sign * step, seen, squares, expected, width)[0] for sign in (1, -1))
        assert slope == pytest.approx((more - less) / 2e-5, rel=1e-4, abs=1e-5)


def test_several_scores_of_a_point_are_what_as_many_points_at_its_place_would_be(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # What stays unknown of a tried place is less after three points there.
    monkeypatch.setattr(gaussian_process, "_NEARLY_THE_SAME", 1e-9)
    rng = np.random.default_rng(1)
    columns, scores = rng.random((6, 4)), rng.normal(size=(6, 3))
    settings = Settings(np.array([0.5, 0.8, 0.3]), 1.2, 0.4)
    means = scores.mean(1)
    repeats = Observed(columns, means, np.full(6, 3.0), float(((scores - means[:, None]) ** 2).sum()))
    apart = Observed(np.repeat(columns, 3, axis=0), scores.ravel(), np.ones(18), 0.0)
    at = rng.random((5, 4))
    for ours, theirs in zip(
        *(Posterior(settings, GROUPS, each, columns[:0]).at(at) for each in (repeats, apart)), strict=True
    ):
        assert ours == pytest.approx(theirs, abs=1e-6)
    found = [fit(each, GROUPS, max_steps=200) for each in (repeats, apart)]
    assert found[0].length_scales == pytest.approx(found[1].length_scales, rel=1e-2)
    assert found[0].noise == pytest.approx(found[1].noise, rel=1e-2)


def test_what_is_awaited_makes_the_process_surer_there_and_expects_nothing_else() -> None:
    rng = np.random.default_rng(2)
    seen, settings = observed_at_random(8, rng), Settings(np.array([0.5, 0.5, 0.5]), 1.0, 0.1)
    at = rng.random((3, 4))
    mean, deviation = Posterior(settings, GROUPS, seen, at[:0]).at(at)
    same, surer = Posterior(settings, GROUPS, seen, at[:1]).at(at)
    assert same == pytest.approx(mean)
    assert surer[0] < 0.5 * deviation[0]
    assert (surer <= deviation + 1e-9).all()


def test_nothing_is_to_be_gained_where_a_point_was_tried_however_noisy_its_score() -> None:
    rng = np.random.default_rng(4)
    seen, settings = observed_at_random(8, rng), Settings(np.array([0.5, 0.5, 0.5]), 1.0, 2.0)
    posterior = Posterior(settings, GROUPS, seen, seen.columns[:0])
    mean, deviation = posterior.at(np.concatenate([seen.columns, rng.random((50, 4))]))
    assert (deviation[:8] < 0.02).all()
    assert deviation[8:].min() > 0.1
    # The noise is in what is expected: far from what was seen, near the mean of all.
    assert (np.abs(mean[:8]) < np.abs(seen.means)).all()
    assert posterior.mean_at_given() == pytest.approx(mean[:8])


def test_settings_tell_the_name_that_matters_and_the_noise() -> None:
    rng = np.random.default_rng(3)
    columns = rng.random((100, 4))
    scores = np.sin(6 * columns[:, 0]) * 1.4 + 0.3 * rng.normal(size=100)
    found = fit(Observed(columns, scores - scores.mean(), np.ones(100), 0.0), GROUPS)
    assert found.length_scales[0] < 0.6 * min(found.length_scales[1:])
    assert math.sqrt(found.noise) == pytest.approx(0.3, rel=0.3)


def test_expected_improvement_is_that_of_the_normal_distribution_far_below_the_best_too() -> None:
    from scipy.stats import norm

    mean, deviation = np.array([-3.0, -2.01, -1.98, 0.0, 4.0]), np.full(5, 2.0)
    u = mean / 2
    expected = np.log(2 * (norm.pdf(u) + u * norm.cdf(u)))
    assert log_expected_improvement(mean, deviation, 0.0) == pytest.approx(expected)
    far = log_expected_improvement(np.array([-20.0, -200.0, -2e4, -2e6]), np.ones(4), 0.0)
    assert np.isfinite(far).all()
    assert (np.diff(far) < 0).all()


def test_a_small_step_leads_to_any_value_of_a_list_in_no_order_but_not_far_in_a_range() -> None:
    space = {name: SPACE[name] for name in ("grid", "uniform")}
    cube = Cube(space)
    origin = cube.units([{"grid": [8], "uniform": 0.5}])
    points = [cube.point(place) for place in _steps(cube, origin, 0.01, np.random.default_rng(0))]
    assert {json.dumps(point["grid"]) for point in points} == {"[8]", "[16, 16]", "[8, 8]"}
    assert all(abs(point["uniform"] - 0.5) < 0.5 for point in points)


# -- asked without a sweep


@pytest.mark.parametrize("method", ["gp", "forest"])
def test_a_space_of_few_points_is_tried_whole_before_one_is_tried_again(method: str) -> None:
    if method == "forest":
        pytest.importorskip("sklearn")
    space = {name: SPACE[name] for name in ("grid", "two")}
    tried: list[KnownPoint] = []
    for index in range(9):
        point = next_point(method, space, tried, index, seed=1, num_startup_trials=1)
        tried.append(KnownPoint(point, (float(len(point["grid"])), None)[: 1 + index % 2]))
    if method == "gp":  # the forest draws each fifth
        assert len({json.dumps(item.point) for item in tried[:6]}) == 6
    assert len({json.dumps(item.point) for item in tried}) >= 5


def test_a_point_is_not_tried_again_because_of_a_value_that_does_not_act_in_it() -> None:
    space = {
        name: TypeAdapter(Domain).validate_python(domain)
        for name, domain in {
            "replay": {"choice": ["none", "uniform", "prioritized"]},
            "n_step": {"choice": [1, 2, 3]},
            "alpha": {"loguniform": [0.01, 1], "when": {"replay": "prioritized"}},
        }.items()
    }
    worth = {"none": 1.0, "uniform": 0.5, "prioritized": 0.0}
    tried: list[KnownPoint] = []
    for index in range(14):
        point = next_point("gp", space, tried, index, seed=0, num_startup_trials=2)
        tried.append(KnownPoint(point, (worth[point["replay"]] + 0.1 * point["n_step"],)))
    assert len({json.dumps(item.point) for item in tried}) == 14


def test_where_all_fail_or_all_are_equal_points_are_still_proposed() -> None:
    for score in (None, 0.0):
        tried = [KnownPoint(point, (score, score)) for point in drawn(12)]
        point = next_point("gp", SPACE, tried, 12, seed=0)
        assert point.keys() == SPACE.keys()
        assert json.loads(json.dumps(point)) == point


def test_what_does_not_act_has_one_value_for_the_model_whatever_was_looked_at() -> None:
    space = {
        name: TypeAdapter(Domain).validate_python(domain)
        for name, domain in {
            "replay": {"choice": ["uniform", "prioritized"]},
            "alpha": {"uniform": [0, 1], "when": {"replay": "prioritized"}},
            "layers": {"layers": {"number": [1, 3], "sizes": [8, 16, 32]}},
            "lr": {"uniform": [0, 1]},
        }.items()
    }
    parts = Parts(space)
    cube = Cube(parts.space)
    places = np.random.default_rng(0).random((200, cube.num_sides))
    settled = _settled(cube, Question(parts.space, [], 0, 0, parts), places)
    for before, after in zip(places, settled, strict=True):
        values = cube.point(before)
        assert cube.point(after) == parts.values_of(parts.point_of(values))
        names = [name in parts.acting(values) for name in parts.space]
        assert (after[names] == before[names]).all()
    assert len({tuple(place[1:2]) for place in settled}) < 150
    assert (_settled(cube, Question(parts.space, [], 0, 0), places) == places).all()

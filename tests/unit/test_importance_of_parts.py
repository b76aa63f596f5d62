"""What mattered where a hyperparameter acts in some points alone, or is searched on a scale of its own."""

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
from known_scores import effect_of, sweep_of

from tests.narrowing import present

CONDITIONAL = {
    "replay": {"choice": ["uniform", "prioritized"]},
    "alpha": {"uniform": [0.01, 1.0], "when": {"replay": "prioritized"}},
    "lr": {"loguniform": [1e-5, 1e-1]},
}


def conditional(count: int) -> list[dict[str, Any]]:
    rng = np.random.default_rng(0)
    points = []
    for _ in range(count):
        point = {"replay": ["uniform", "prioritized"][rng.integers(2)], "alpha": float(rng.uniform(0.01, 1.0))}
        if point["replay"] == "uniform":
            del point["alpha"]
        points.append({**point, "lr": float(10 ** rng.uniform(-5, -1))})
    return points


def test_what_acts_with_one_value_takes_nothing_from_that_value() -> None:
    made = sweep_of(conditional(60), lambda point: 10.0 * (point["replay"] == "prioritized"), space=CONDITIONAL)
    mattered = made.mattered
    assert mattered.names[0] == "replay"
    shares = {item.name: item for item in mattered.hyperparams}
    assert shares["replay"].is_clear
    assert present(shares["replay"].share) > 0.6
    assert not shares["alpha"].is_clear
    assert present(shares["alpha"].share) < 0.05
    # Each level of the one is compared, though the other acts in one of them alone.
    assert effect_of(mattered, "replay").why_not_comparable == ""
    levels = {level.label: level for level in effect_of(mattered, "replay").levels}
    gap = present(levels["prioritized"].adjusted) - present(levels["uniform"].adjusted)
    assert gap == pytest.approx(10, abs=1.5)


def test_what_matters_where_it_acts_is_found_there() -> None:
    def score(point: dict[str, Any]) -> float:
        return 20.0 * point["alpha"] if "alpha" in point else 10.0

    mattered = sweep_of(conditional(80), score, space=CONDITIONAL).mattered
    shares = {item.name: item for item in mattered.hyperparams}
    assert mattered.names[0] == "alpha"
    assert shares["alpha"].is_clear
    assert not shares["replay"].is_clear
    levels = effect_of(mattered, "alpha").levels
    assert [level.label for level in levels] == ["0.01 to 0.34", "0.34 to 0.67", "0.67 to 1"]
    assert sum(level.num_points for level in levels) == sum("alpha" in point for point in conditional(80))
    assert [level.adjusted for level in levels] == pytest.approx([level.mean for level in levels], abs=0.5)
    assert mattered.interactions == ()


def test_points_in_which_it_does_not_act_move_none_of_its_means() -> None:
    def score(point: dict[str, Any], elsewhere: float) -> float:
        return 20.0 * point["alpha"] if "alpha" in point else elsewhere

    for elsewhere in (10.0, 1000.0):
        mattered = sweep_of(conditional(80), partial(score, elsewhere=elsewhere), space=CONDITIONAL).mattered
        levels = effect_of(mattered, "alpha").levels
        assert [level.adjusted for level in levels] == pytest.approx([level.mean for level in levels], abs=30.0)


def test_a_listed_value_that_does_not_act_is_no_level() -> None:
    space = {**CONDITIONAL, "alpha": {"choice": [0.2, 0.6], "when": {"replay": "prioritized"}}}
    points = [
        {**point, "alpha": [0.2, 0.6][index % 3 == 0]} if "alpha" in point else point
        for index, point in enumerate(conditional(60))
    ]
    mattered = sweep_of(points, lambda point: 10.0 * (point.get("alpha") == 0.6), space=space).mattered
    assert [level.label for level in effect_of(mattered, "alpha").levels] == ["0.2", "0.6"]
    assert mattered.names[0] == "alpha"


def test_layers_are_judged_by_their_number_and_by_the_size_of_each() -> None:
    rng = np.random.default_rng(0)
    points = [{"hidden_sizes": [int(size) for size in rng.choice([16, 32, 64], rng.integers(1, 4))]} for _ in range(80)]
    space = {"hidden_sizes": {"layers": {"number": [1, 3], "sizes": {"choice": [16, 32, 64]}}}}
    by_number = sweep_of(points, lambda point: 5.0 * len(point["hidden_sizes"]), space=space).mattered
    assert by_number.names[0] == "hidden_sizes.number"
    assert [item.is_clear for item in by_number.hyperparams] == [True, False, False, False]
    by_first = sweep_of(points, lambda point: 0.2 * point["hidden_sizes"][0], space=space).mattered
    assert [item.name for item in by_first.hyperparams if item.is_clear] == ["hidden_sizes.1"]
    third = effect_of(by_first, "hidden_sizes.3").levels
    assert sum(level.num_points for level in third) == sum(len(point["hidden_sizes"]) == 3 for point in points)


def test_values_near_one_are_judged_on_the_scale_of_their_distance() -> None:
    rng = np.random.default_rng(0)
    points = [{"gamma": 1.0 - float(10 ** rng.uniform(-4, -1))} for _ in range(60)]
    space = {"gamma": {"one_minus_loguniform": [0.9, 0.9999]}}
    mattered = sweep_of(points, lambda point: -abs(math.log10(1 - point["gamma"]) + 2.5), space=space).mattered
    labels = [level.label for level in effect_of(mattered, "gamma").levels]
    assert labels == ["0.9 to 0.99", "0.99 to 0.999", "0.999 to 0.9999"]


@pytest.mark.parametrize(
    ("domain", "values", "wider"),
    [
        ({"power_of_two": [16, 128]}, [16, 32, 64, 128], {"power_of_two": [16, 512]}),
        (
            {"one_minus_loguniform": [0.9, 0.999]},
            [0.9, 0.97, 0.99, 0.997, 0.999],
            {"one_minus_loguniform": [0.9, 0.99978]},
        ),
    ],
)
def test_ends_are_moved_on_the_scale_of_their_kind(domain: Any, values: list[float], wider: Any) -> None:
    points = [{"x": values[index % len(values)]} for index in range(60)]
    rank = {value: 10.0 * place for place, value in enumerate(values)}
    mattered = sweep_of(points, lambda point: rank[point["x"]], space={"x": domain}).mattered
    (edge,) = mattered.edges
    assert edge.domain == wider


def test_ends_are_moved_though_the_length_of_training_matters_too() -> None:
    rng = np.random.default_rng(0)
    points = [
        {"lr": float(10 ** rng.uniform(-5, -1)), "stop.num_env_steps": int(rng.choice([500, 1000]))} for _ in range(80)
    ]

    def score(point: dict[str, Any]) -> float:
        return float(10.0 * math.log10(point["lr"]) + point["stop.num_env_steps"] / 20)

    space = {"lr": {"loguniform": [1e-5, 1e-1]}, "stop.num_env_steps": {"choice": [500, 1000]}}
    mattered = sweep_of(points, score, space=space, algorithm="dqn").mattered
    assert {item.name for item in mattered.hyperparams if item.is_clear} == {"lr", "stop.num_env_steps"}
    assert [(edge.name, edge.side) for edge in mattered.edges] == [("lr", "high")]


def test_ends_are_moved_though_the_best_point_lacks_what_matters_elsewhere() -> None:
    name = "prioritized_alpha"
    space = {**CONDITIONAL, name: CONDITIONAL["alpha"]}
    del space["alpha"]
    points = [{name if key == "alpha" else key: value for key, value in point.items()} for point in conditional(80)]

    def score(point: dict[str, Any]) -> float:
        return 10.0 * math.log10(point["lr"]) + (30.0 * point[name] if name in point else 40.0)

    mattered = sweep_of(points, score, space=space, algorithm="dqn").mattered
    assert {item.name for item in mattered.hyperparams if item.is_clear} >= {"lr", name}
    assert [(edge.name, edge.side) for edge in mattered.edges] == [("lr", "high")]

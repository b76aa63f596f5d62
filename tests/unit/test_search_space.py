"""Domains: what they give, what they refuse, and that the points drawn from them can be drawn again."""

import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from tune_jobs.spec.domains import DOMAIN_KINDS, Domain
from tune_jobs.spec.draws import draw_points

ADAPTER = TypeAdapter(Domain)


def domain(**raw: Any) -> Any:
    return ADAPTER.validate_python(raw)


def samples(parsed: Any, num: int = 2_000) -> list[bool | float]:
    rng = np.random.default_rng(0)
    return [parsed.sample(rng) for _ in range(num)]


def message(raw: Any) -> str:
    with pytest.raises(ValidationError) as caught:
        ADAPTER.validate_python(raw)
    return str(caught.value)


def test_uniform_fills_its_range_evenly() -> None:
    drawn = samples(domain(uniform=[2, 10]))
    assert all(isinstance(value, float) and 2 <= value < 10 for value in drawn)
    assert abs(np.mean(drawn) - 6) < 0.2
    assert min(drawn) < 2.1
    assert max(drawn) > 9.9


def test_loguniform_gives_each_decade_the_same_share() -> None:
    drawn = samples(domain(loguniform=[1e-5, 1e-1]))
    shares = Counter(math.floor(math.log10(value)) for value in drawn)
    assert set(shares) == {-5, -4, -3, -2}
    assert all(abs(count / len(drawn) - 0.25) < 0.05 for count in shares.values())


@pytest.mark.parametrize(
    ("raw", "expected"),
    [
        ({"randint": [3, 6]}, {3, 4, 5}),
        ({"lograndint": [1, 5]}, {1, 2, 3, 4}),
        ({"qrandint": [10, 40, 10]}, {10, 20, 30, 40}),
        ({"qrandint": [15, 45, 10]}, {20, 30, 40}),
        ({"qrandint": [3, 6, 1]}, {3, 4, 5}),
        ({"qlograndint": [16, 64, 16]}, {16, 32, 48, 64}),
        ({"quniform": [0.1, 0.5, 0.1]}, {0.1, 0.2, 0.3, 0.4, 0.5}),
        ({"quniform": [0.1, 0.3, 0.1]}, {0.1, 0.2, 0.3}),
        ({"qloguniform": [0.25, 1, 0.25]}, {0.25, 0.5, 0.75, 1.0}),
        ({"choice": ["a", [1, 2]]}, None),
        ({"grid": [True, False]}, {True, False}),
    ],
)
def test_whole_and_quantised_domains_give_exactly_their_values(
    raw: dict[str, Any], expected: set[bool | float] | None
) -> None:
    parsed = domain(**raw)
    drawn = samples(parsed)
    if expected is None:
        assert all(value in parsed.values for value in drawn)
        assert {repr(value) for value in drawn} == {repr(value) for value in parsed.values}
        return
    assert set(drawn) == expected
    if "int" in parsed.kind:
        assert all(type(value) is int for value in drawn)
    if parsed.kind not in ("grid", "choice"):
        assert parsed.bounds == (min(expected), max(expected))


def test_the_log_form_favours_small_values() -> None:
    counts = Counter(samples(domain(lograndint=[1, 9])))
    assert counts[1] > 2 * counts[4] > 0


@pytest.mark.parametrize(
    ("raw", "part"),
    [
        ({"grid": []}, "is empty"),
        ({"choice": []}, "is empty"),
        ({"grid": [[32], [64], [32]]}, "lists [32] twice"),
        ({"uniform": [1, 1]}, "goes from 1.0 to 1.0"),
        ({"randint": [5, 2]}, "goes from 5 to 2"),
        ({"loguniform": [0, 1]}, "starts at 0.0: a log scale needs a start greater than 0"),
        ({"lograndint": [-1, 4]}, "starts at -1"),
        ({"quniform": [0, 1, 0]}, "has the step 0"),
        ({"qrandint": [0, 10, -2]}, "has the step -2"),
        ({"qrandint": [11, 19, 10]}, "no multiple of 10 between 11 and 19"),
        ({"uniform": [0, float("inf")]}, "finite"),
        ({"uniform": [0, "1"]}, "'1' is of the wrong type: write 1 if that is meant"),
        ({"uniform": [False, 1]}, "false is not a number"),
        ({"randint": [0, 1.5]}, "1.5"),
        ({"uniform": [1]}, "Field required"),
        ({"uniform": [1, 2, 3]}, "at most 2 items"),
        ({"unifrom": [1, 2]}, "Did you mean 'uniform'?"),
        ({}, "needs exactly one key"),
        ({"grid": [1], "choice": [2]}, "needs exactly one key"),
        ([32, 64], "{grid: [32, 64]}"),
        (0.01, "fix it under hyperparams"),
    ],
)
def test_wrong_domains_are_refused_with_their_values(raw: Any, part: str) -> None:
    assert part in message(raw)


def test_values_that_python_calls_equal_are_different_in_a_grid() -> None:
    assert domain(grid=[1, True, 1.0]).values == (1, True, 1.0)


def test_every_domain_survives_json() -> None:
    numbers = {"grid": [[32], "relu", None], "choice": [1, 2]}
    for kind in DOMAIN_KINDS:
        numbers |= {"one_minus_loguniform": [0.9, 0.99], "layers": {"number": [1, 2], "sizes": [16, 32]}}
        parsed = domain(**{kind: numbers.get(kind, [2, 64, 2] if kind.startswith("q") else [2, 64])})
        assert ADAPTER.validate_json(parsed.model_dump_json()) == parsed


SPACE = {
    "hidden": domain(grid=[[32], [64]]),
    "lr": domain(uniform=[0, 1]),
    "act": domain(grid=["linear", "relu"]),
}


def test_points_go_through_the_grid_once_a_sample_in_file_order() -> None:
    points = draw_points(SPACE, 2, sweep_seed=0)
    combinations = [([32], "linear"), ([32], "relu"), ([64], "linear"), ([64], "relu")]
    assert [(point["hidden"], point["act"]) for point in points] == combinations * 2
    assert all(list(point) == ["hidden", "lr", "act"] for point in points)
    assert len({point["lr"] for point in points}) == 8


def test_more_samples_change_no_earlier_point() -> None:
    assert draw_points(SPACE, 5, sweep_seed=3)[:8] == draw_points(SPACE, 2, sweep_seed=3)


def test_the_sweep_seed_decides_the_points() -> None:
    first, again, other = (draw_points(SPACE, 2, sweep_seed=seed) for seed in (0, 0, 1))
    assert first == again
    assert {point["lr"] for point in first}.isdisjoint(point["lr"] for point in other)


def test_points_are_what_they_always_were() -> None:
    # A change here breaks `extend` and `resume` of the sweeps people already have.
    space = {"lr": domain(loguniform=[1e-5, 1e-2]), "n": domain(randint=[0, 1000])}
    assert draw_points(space, 2, sweep_seed=7) == [
        pytest.approx(point) for point in [{"lr": 0.000150079572571204, "n": 804}, {"lr": 0.004156478866087, "n": 479}]
    ]


def test_an_empty_space_is_one_point_a_sample() -> None:
    assert draw_points({}, 3, 0) == [{}, {}, {}]


@pytest.mark.parametrize(
    "raw",
    [
        {"randint": [1, 2**63]}, {"lograndint": [1, 10**39]}, {"qrandint": [-(10**30), 10, 5]},
        {"uniform": [-1e308, 1e308]}, {"quniform": [0, 1e300, 1e-300]}, {"qloguniform": [1e-300, 1e300, 1e-300]},
    ],
)  # fmt: skip
def test_a_range_that_nothing_can_be_drawn_from_is_refused(raw: dict[str, Any]) -> None:
    assert "goes from" in message(raw)
    (kind,) = raw
    # Half as wide, or nearly so, is drawn from.
    narrow = {"randint": [1, 2**63 - 1], "lograndint": [1, 10**18], "qrandint": [-(10**12), 10, 5]}
    floats = {"uniform": [-8e307, 8e307], "quniform": [0, 1e15, 1], "qloguniform": [1, 1e15, 1]}
    assert all(low is not None for low in samples(domain(**{kind: {**narrow, **floats}[kind]}), 20))

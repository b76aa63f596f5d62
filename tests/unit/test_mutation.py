"""How population based training changes values: always within the domain, near the better trial's or drawn anew."""

from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from policies import random_streams
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM
from tune_jobs.search.mutation import mutate
from tune_jobs.spec.domains import Domain
from tune_jobs.spec.rules import FIXED_IN_A_POPULATION

DOMAIN = TypeAdapter(Domain)


def neighbours(
    domain: dict[str, list[Any]],
    value: Any,
    resample_probability: float = 0.0,
    draws: int = 300,
) -> set[str]:
    space = {"x": DOMAIN.validate_python(domain)}
    rng = np.random.default_rng(0)
    return {repr(mutate({"x": value}, space, rng, resample_probability)["x"]) for _ in range(draws)}


@pytest.mark.parametrize(
    ("domain", "value", "expected"),
    [
        ({"uniform": [0.0, 1.0]}, 0.5, {0.5 * 0.8, 0.5 * 1.2}),
        ({"uniform": [0.0, 1.0]}, 0.9, {0.9 * 0.8, 1.0}),
        ({"loguniform": [1e-4, 1e-2]}, 1e-4, {1e-4, 1.2e-4}),
        ({"quniform": [0.0, 1.0, 0.1]}, 0.5, {0.4, 0.6}),
        ({"qloguniform": [0.1, 1.0, 0.1]}, 0.1, {0.1, 0.2}),
        ({"randint": [1, 10]}, 2, {1, 3}),
        ({"randint": [1, 101]}, 50, {40, 60}),
        ({"randint": [1, 10]}, 9, {7, 9}),
        ({"qrandint": [32, 256, 32]}, 256, {192, 256}),
        ({"lograndint": [1, 10]}, 1, {1, 2}),
        ({"grid": [1, 5, 9, 20]}, 5, {1, 9}),
        ({"choice": ["a", "b", "c"]}, "c", {"b", "c"}),
        ({"choice": [True, False]}, True, {True, False}),
    ],
)
def test_a_neighbouring_value_is_one_step_away_and_in_the_domain(
    domain: dict[str, list[Any]], value: float | str, expected: set[float | str]
) -> None:
    assert neighbours(domain, value) == {repr(value) for value in expected}


def test_a_list_of_sizes_read_back_from_json_is_found_again() -> None:
    assert neighbours({"grid": [[16], [32], [64, 64]]}, [32]) == {"[16]", "[64, 64]"}


def test_a_value_drawn_anew_comes_from_the_whole_domain() -> None:
    assert neighbours({"choice": [1, 2, 3, 4, 5]}, 1, resample_probability=1.0) == {"1", "2", "3", "4", "5"}
    assert neighbours({"choice": [1, 2, 3, 4, 5]}, 1, resample_probability=0.0) == {"1", "2"}


def test_the_resample_probability_is_the_share_of_values_drawn_anew() -> None:
    space = {"x": DOMAIN.validate_python({"uniform": [0.0, 1.0]})}
    rng = np.random.default_rng(1)
    values = [mutate({"x": 0.5}, space, rng, 0.3)["x"] for _ in range(2000)]
    anew = sum(value not in (0.5 * 0.8, 0.5 * 1.2) for value in values)
    assert 0.25 < anew / 2000 < 0.35


def test_the_same_trial_and_change_give_the_same_mutation_and_others_another() -> None:
    draws = {key: random_streams.mutation(*key).random() for key in [(0, 1, 0), (0, 1, 1), (0, 2, 0), (1, 1, 0)]}
    assert len(set(draws.values())) == 4
    assert random_streams.mutation(0, 1, 1).random() == draws[0, 1, 1]


def test_all_names_that_are_refused_exist() -> None:
    known = {name for model in HYPERPARAMS_BY_ALGORITHM.values() for name in model.model_fields}
    assert known >= FIXED_IN_A_POPULATION

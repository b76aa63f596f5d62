"""Interquartile mean, bootstrap intervals and paired differences against known values."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.statistics import iqm, mean_with_ci, median_steps, paired_difference, small_sample_note

finite = st.floats(-1e6, 1e6)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([5.0], 5.0),
        ([1.0, 2.0, 600.0], 201.0),  # nothing is cut of three: their mean
        ([0.0, 10.0, 20.0, 1000.0], 15.0),
        ([1000.0, 20.0, 0.0, 10.0], 15.0),
        ([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0], 4.0),
        ([-500.0, -400.0, 1.0, 2.0, 3.0, 4.0, 500.0, 900.0], 2.5),
    ],
)
def test_iqm_cuts_a_quarter_at_each_end(values: list[float], expected: float) -> None:
    assert iqm(values) == pytest.approx(expected)


@given(st.lists(finite, min_size=1, max_size=40))
def test_iqm_lies_within_the_values(values: list[float]) -> None:
    assert min(values) - 1e-6 <= iqm(values) <= max(values) + 1e-6


@pytest.mark.parametrize("bad", [[], [1.0, math.nan], [math.inf], [[1.0, 2.0]]])
def test_no_number_is_made_up_of_bad_values(bad: list[float | list[float]]) -> None:
    for call in (iqm, lambda values: mean_with_ci(values, rng=np.random.default_rng(0))):
        with pytest.raises(ValueError, match=r"finite|non-empty"):
            call(bad)  # type: ignore[arg-type]


def test_the_interval_of_a_mean_is_about_what_theory_says() -> None:
    values = np.random.default_rng(3).normal(100.0, 20.0, size=400)
    estimate = mean_with_ci(values, rng=np.random.default_rng(0))
    half = 1.96 * values.std() / math.sqrt(400)
    assert estimate.mean == pytest.approx(values.mean())
    assert estimate.num_values == 400
    assert estimate.lower == pytest.approx(values.mean() - half, abs=0.4)
    assert estimate.upper == pytest.approx(values.mean() + half, abs=0.4)


def test_a_higher_level_is_wider() -> None:
    values = np.arange(30.0)
    narrow = mean_with_ci(values, rng=np.random.default_rng(0), level=0.5)
    wide = mean_with_ci(values, rng=np.random.default_rng(0), level=0.99)
    assert wide.lower < narrow.lower < narrow.upper < wide.upper
    with pytest.raises(ValueError, match="level"):
        mean_with_ci(values, rng=np.random.default_rng(0), level=95)


def test_the_generator_given_is_the_one_used() -> None:
    values = np.arange(30.0)
    first, again, other = (mean_with_ci(values, rng=np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert first == again
    assert first != other


def test_many_values_are_resampled_in_blocks() -> None:
    estimate = mean_with_ci(np.ones(3_000_000), rng=np.random.default_rng(0), num_resamples=3)
    assert (estimate.lower, estimate.upper) == (1.0, 1.0)


def test_pairs_cancel_what_they_share() -> None:
    rng = np.random.default_rng(0)
    shared = rng.normal(0.0, 100.0, size=50)
    difference = paired_difference(shared + 5.0, shared, rng=rng)
    assert (difference.mean, difference.lower, difference.upper) == pytest.approx((5.0, 5.0, 5.0))
    assert paired_difference([1.0, 2.0], [3.0, 5.0], rng=rng).mean == -2.5
    with pytest.raises(ValueError, match="cannot pair 2 values with 3"):
        paired_difference([1.0, 2.0], [1.0, 2.0, 3.0], rng=rng)


def test_too_few_seeds_are_said() -> None:
    assert "one seed" in small_sample_note(1)
    assert "3 seeds" in small_sample_note(3)
    assert small_sample_note(5) == ""


def test_the_median_of_steps_counts_never_as_last() -> None:
    assert median_steps([3000]) == 3000
    assert median_steps([5000, 1000, None]) == 5000
    assert median_steps([1000, 2000]) == 1500
    assert median_steps([1000, None, None]) is None
    assert median_steps([1000, None]) is None
    assert median_steps([None]) is None
    with pytest.raises(ValueError, match="no seeds"):
        median_steps([])

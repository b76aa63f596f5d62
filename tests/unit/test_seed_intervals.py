"""Intervals over few training seeds: against SciPy and arch, and against the truth in simulated sweeps."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from simulated_sweeps import WORLDS, coverage

from analysis.statistics import (
    Estimate,
    bootstrap_t_interval,
    mean_with_ci,
    moderated_means,
    seed_intervals,
    seeds_differ,
    t_interval,
    t_quantile,
    tie_groups,
)

SCORES = [100.0, 120.0, 90.0, 300.0, 150.0, 110.0, 95.0, 200.0, 130.0, 105.0]

COVERED = sorted(set(WORLDS) - {"solves in 90 %"})
"""Not covered: where every setting solves in 90 % of its runs. Most see no collapse in ten seeds or see one, and what
is seen of the variance is spread over all settings: five seeds cover 98.7 %, ten 90.3 % (Student's t 41 and 65 %)."""


@pytest.mark.parametrize("df", [1.0, 1.5, 2.0, 4.7, 9.0, 38.0, 400.5, 5e4, 2e5, 1e9, math.inf])
def test_quantiles_of_t_are_scipys(df: float) -> None:
    for probability in (1e-6, 0.025, 0.4, 0.5, 0.6, 0.95, 0.975, 0.9999, 1.0 - 1e-9):
        assert t_quantile(probability, df) == pytest.approx(stats.t.ppf(probability, df), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(("probability", "df"), [(0.0, 3.0), (1.0, 3.0), (math.nan, 3.0), (0.5, 0.5), (0.5, math.nan)])
def test_quantiles_that_are_none(probability: float, df: float) -> None:
    with pytest.raises(ValueError, match=r"not in \(0, 1\)|less than 1"):
        t_quantile(probability, df)


@pytest.mark.parametrize("level", [0.5, 0.95, 0.999])
@pytest.mark.parametrize("count", [2, 3, 10])
def test_students_interval_is_scipys(count: int, level: float) -> None:
    values = SCORES[:count]
    estimate = t_interval(values, level=level)
    expected = stats.t.interval(level, count - 1, loc=np.mean(values), scale=stats.sem(values))
    assert (estimate.lower, estimate.upper) == pytest.approx(expected)
    assert estimate.mean == pytest.approx(np.mean(values))
    assert (estimate.num_values, estimate.note) == (count, "")


def test_the_percentile_bootstrap_is_scipys() -> None:
    estimate = mean_with_ci(SCORES, rng=np.random.default_rng(0), num_resamples=20_000)
    expected = stats.bootstrap((SCORES,), np.mean, method="percentile", n_resamples=20_000, rng=1).confidence_interval
    assert (estimate.lower, estimate.upper) == pytest.approx((expected.low, expected.high), rel=0.02)


def test_the_studentized_bootstrap_is_that_of_arch() -> None:
    # arch 7.2.0: IIDBootstrap(SCORES, seed=1).conf_int(mean, reps=100_000, method="studentized", std_err_func=standard
    # error); the quantiles of its studentized means. Its interval takes the bootstrap's standard error of the mean, a
    # factor of sqrt(9 / 10) smaller, where Efron & Tibshirani take the sample's.
    low, high = -6.33797, 1.60328
    error = np.std(SCORES, ddof=1) / math.sqrt(10)
    estimate = bootstrap_t_interval(SCORES, rng=np.random.default_rng(0), num_resamples=50_000)
    assert estimate.lower == pytest.approx(140.0 - high * error, rel=0.01)
    assert estimate.upper == pytest.approx(140.0 - low * error, rel=0.02)
    assert estimate.upper - 140.0 > 2.0 * (140.0 - estimate.lower)  # longer where the tail is


def test_a_studentized_bootstrap_without_a_bound_says_so() -> None:
    few = bootstrap_t_interval([1.0, 2.0, 4.0], rng=np.random.default_rng(0))
    assert (few.lower, few.upper) == (-math.inf, math.inf)
    assert few.note == "3 seeds of few different scores set no bound"


@pytest.mark.parametrize(
    "interval", [t_interval, lambda values: bootstrap_t_interval(values, rng=np.random.default_rng(0))]
)
def test_bad_values_of_one_setting(interval: Callable[[Sequence[float]], Estimate]) -> None:
    with pytest.raises(ValueError, match="non-empty"):
        interval([])
    with pytest.raises(ValueError, match="two seeds or more"):
        interval([3.0])
    with pytest.raises(ValueError, match="1 of 2 values are not finite"):
        interval([3.0, math.nan])
    same = interval([0.1] * 5)
    assert same.lower == same.mean == same.upper
    assert same.note == "all 5 seeds score the same: up to 45% of other seeds may not"


def test_moderated_variances_by_hand() -> None:
    # Variances 0, 8 and 50 with 1 degree of freedom each: mean 58 / 3, mean square 2564 / 3, of which a third is
    # chance's. (2564 / 9) / (58 / 3)^2 < 1, so they differ no more than chance would make them: all are pooled.
    pooled = moderated_means([[5.0, 5.0], [1.0, 5.0], [0.0, 10.0]])
    assert pooled.common_variance
    assert pooled.standard_errors == pytest.approx([math.sqrt(58.0 / 6.0)] * 3)
    assert pooled.dfs == pytest.approx([3.0] * 3)

    # Variances 1 and 100 with 4 degrees of freedom: mean 50.5, mean square 5000.5, over 1.5 it is 3333.67;
    # 3333.67 / 2550.25 - 1 = 0.307193, so d0 = 4 + 2 / 0.307193 = 10.5106 and s0^2 = 50.5 x 8.5106 / 10.5106 = 40.8906.
    unit = np.array([-1.0, -1.0, 0.0, 1.0, 1.0])
    fit = moderated_means([unit, 10.0 * unit])
    assert not fit.common_variance
    expected = [(10.5106 * 40.8906 + 4.0 * own) / 14.5106 for own in (1.0, 100.0)]
    assert fit.standard_errors**2 * 5.0 == pytest.approx(expected, rel=1e-4)
    assert fit.dfs == pytest.approx([8.0, 8.0])  # not 14.5: there are no more


def test_the_prior_is_found_again() -> None:
    rng = np.random.default_rng(0)
    prior_df, prior_variance, count = 12.0, 4.0, 20_000
    scales = np.sqrt(prior_df * prior_variance / rng.chisquare(prior_df, size=(count, 1)))
    fit = moderated_means(list(scales * rng.standard_normal((count, 5))))
    assert fit.dfs[0] - 4.0 == pytest.approx(prior_df, rel=0.15)
    # The median setting's variance is drawn to the prior's.
    assert np.median(fit.standard_errors**2 * 5.0) == pytest.approx(prior_variance, rel=0.1)


def test_of_one_setting_alone_it_is_students() -> None:
    alone, student = seed_intervals([SCORES])[0], t_interval(SCORES)
    assert (alone.lower, alone.upper) == pytest.approx((student.lower, student.upper))


def test_what_a_setting_doesnt_know_others_do() -> None:
    alone, same, wide = seed_intervals([[7.0], [500.0] * 5, [20.0, 500.0, 500.0, 100.0, 480.0]], bounds=(0.0, 500.0))
    assert alone.note == "one seed: the width is that of other settings"
    assert same.note == "its 5 seeds score the same: the width is that of other settings"
    assert wide.note == ""
    assert alone.lower == 0.0  # cut off
    assert same.lower < 480.0
    assert same.upper == 500.0


def test_scores_that_never_differ_are_said() -> None:
    for estimate in seed_intervals([[5.0, 5.0], [7.0, 7.0, 7.0]]):
        assert estimate.lower == estimate.mean == estimate.upper
        assert estimate.note == "in no setting any two seeds differ: how much they may is not known"


@pytest.mark.parametrize("exponent", [-3, -600, -1000])
def test_small_scores_have_the_intervals_of_large_ones_to_the_bit(exponent: int) -> None:
    settings = [[1.0, 3.0, 7.0], [9.0], [8.0, 8.0]]
    small = [[math.ldexp(score, exponent) for score in scores] for scores in settings]
    fit, scaled = moderated_means(settings), moderated_means(small)
    np.testing.assert_array_equal(scaled.standard_errors, np.ldexp(fit.standard_errors, exponent))
    np.testing.assert_array_equal(scaled.dfs, fit.dfs)
    for estimate, other in zip(seed_intervals(settings), seed_intervals(small), strict=True):
        assert (other.lower, other.upper) == (
            math.ldexp(estimate.lower, exponent),
            math.ldexp(estimate.upper, exponent),
        )
    ties, same = (tie_groups(scores, rng=np.random.default_rng(0)) for scores in (settings, small))
    assert (same.groups, same.with_leader) == (ties.groups, ties.with_leader)


def test_whether_seeds_differ_is_known_of_scores_of_any_size() -> None:
    for unit in (5e-324, 1e-170, 1.0, 1e200, 1e307):
        assert seeds_differ([[unit], [2 * unit, 5 * unit]])
        assert not seeds_differ([[unit], [2 * unit, 2 * unit]])
    assert not seeds_differ([[1.0], [2.0]])


def test_bad_values_of_settings() -> None:
    with pytest.raises(ValueError, match="settings is empty"):
        seed_intervals([])
    with pytest.raises(ValueError, match=r"settings\[1\]: expected a 1-D, non-empty"):
        seed_intervals([[1.0, 2.0], []])
    with pytest.raises(ValueError, match=r"settings\[0\]: 1 of 2 values are not finite"):
        seed_intervals([[1.0, math.inf], [1.0]])
    with pytest.raises(ValueError, match="no setting has two seeds"):
        seed_intervals([[1.0], [2.0]])
    with pytest.raises(ValueError, match="squares are not finite"):
        seed_intervals([[1e200, -1e200]])
    with pytest.raises(ValueError, match=r"means from 1\.5 to 1\.5 are not within 2 and 3"):
        seed_intervals([[1.0, 2.0]], bounds=(2.0, 3.0))
    with pytest.raises(ValueError, match="level"):
        seed_intervals([[1.0, 2.0]], level=1.0)


def test_thousands_of_settings_are_each_given_an_interval() -> None:
    scores = np.random.default_rng(0).standard_normal((5_000, 3))
    estimates = seed_intervals(list(scores))
    assert len(estimates) == 5_000
    assert estimates[7].mean == pytest.approx(scores[7].mean())


@pytest.mark.parametrize(("world", "seeds"), list(product(COVERED, (5, 10))))
def test_moderated_intervals_cover_what_they_state(world: str, seeds: int) -> None:
    """Of 95 % intervals over 5 and 10 seeds of 20 settings 92 to 98 % hold the truth; not in the world left out."""
    rng = np.random.default_rng(5)
    sweeps = [WORLDS[world](rng, 20, seeds) for _ in range(60)]
    assert 0.92 <= coverage(sweeps, lambda scores: seed_intervals(list(scores))) <= 0.98


def test_why_other_intervals_are_not_the_default() -> None:
    """Of runs that solve or collapse neither t nor any bootstrap of a setting's own five seeds covers 95 %."""
    rng = np.random.default_rng(5)
    sweeps = [WORLDS["solves in 70 %"](rng, 20, 5) for _ in range(10)]
    own: list[Callable[[Sequence[float]], Estimate]] = [
        t_interval,
        lambda values: mean_with_ci(values, rng=rng, num_resamples=200),
        lambda values: bootstrap_t_interval(values, rng=rng, num_resamples=200),
    ]
    for interval in own:
        assert coverage(sweeps, partial(_of_each, interval)) < 0.9


def _of_each(interval: Callable[[Sequence[float]], Estimate], scores: NDArray[np.float64]) -> list[Estimate]:
    return [interval(row.tolist()) for row in scores]

"""Interquartile means, performance profiles and P(X > Y) over tasks: against rliable, SciPy and the truth."""

import math

import numpy as np
import pytest
from scipy import stats

from analysis.statistics import iqm_with_ci, performance_profile, probability_of_improvement

X = [[0.1, 0.5, 0.9, 0.3, 0.7], [0.9, 0.7, 0.8, 0.95, 0.2], [0.4, 0.2, 0.6, 0.5, 0.1]]
Y = [[0.2, 0.4, 0.5, 0.1], [0.8, 0.6, 0.9, 0.7], [0.3, 0.2, 0.9, 0.1]]


def test_the_interquartile_mean_of_tasks_is_that_of_rliable() -> None:
    # rliable 1.2.0: get_interval_estimates of metrics.aggregate_iqm, reps=20_000, numpy.random.seed(0).
    i = np.arange(100)
    tasks = [(i * 37 % 100) / 100, ((i * 53 % 100) / 100) ** 3, np.where(i < 60, 1.0, (i - 60) / 100)]
    estimate = iqm_with_ci(tasks, rng=np.random.default_rng(0), num_resamples=5_000)
    assert estimate.mean == pytest.approx(0.4320865)
    assert (estimate.lower, estimate.upper) == pytest.approx((0.37010, 0.49634), abs=0.004)
    assert (estimate.num_values, estimate.note) == (300, "")
    assert estimate.mean == pytest.approx(stats.trim_mean(np.concatenate(tasks), 0.25))


def test_few_runs_are_resampled_as_fresh_ones_would_vary() -> None:
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(150):
        # The interquartile mean of four normal tasks that lie evenly around 0 is 0.
        tasks = [centre + rng.standard_normal(5) for centre in (-1.0, -0.3, 0.3, 1.0)]
        estimate = iqm_with_ci(tasks, rng=rng, num_resamples=300)
        held += estimate.lower <= 0.0 <= estimate.upper
    assert 0.92 <= held / 150 <= 0.98


def test_tasks_are_resampled_each_by_itself() -> None:
    # Resampled together, the mean of a constant 0 and a constant 1 would vary.
    estimate = iqm_with_ci([[0.0] * 8, [1.0] * 8], rng=np.random.default_rng(0))
    assert (estimate.lower, estimate.mean, estimate.upper) == (0.5, 0.5, 0.5)


def test_few_runs_are_said() -> None:
    assert iqm_with_ci([[1.0, 2.0, 4.0]], rng=np.random.default_rng(0)).note == "3 runs: the interval may be too narrow"
    with pytest.raises(ValueError, match="no task has two runs"):
        iqm_with_ci([[1.0], [2.0]], rng=np.random.default_rng(0))


def test_profiles_are_those_of_rliable() -> None:
    # rliable 1.2.0: create_performance_profile.
    profile = performance_profile(X, np.linspace(0.0, 1.0, 6))
    assert profile.shares == pytest.approx([1.0, 11.0 / 15.0, 0.6, 0.4, 0.2, 0.0])
    assert (profile.lower[-1], profile.upper[0]) == (0.0, 1.0)
    assert profile.lower[0] < 0.85
    assert profile.upper[-1] > 0.15


def test_intervals_of_a_profile_are_wilsons() -> None:
    values = np.arange(12.0)
    profile = performance_profile([values], [2.5, 5.5, 100.0])
    for share, lower, upper in zip(profile.shares, profile.lower, profile.upper, strict=True):
        expected = stats.binomtest(round(share * 12), 12).proportion_ci(method="wilson")
        assert (lower, upper) == pytest.approx((expected.low, expected.high))
    # A task of its own, with the same shares, halves the variance as so many runs more would.
    twice = performance_profile([values, values], [2.5])
    same = performance_profile([np.concatenate([values, values])], [2.5])
    assert twice.lower == pytest.approx(same.lower)
    assert twice.upper == pytest.approx(same.upper)


def test_a_run_at_the_threshold_is_not_above_it() -> None:
    assert performance_profile([[1.0, 2.0, 3.0, 3.0]], [3.0, 2.0, 0.0]).shares.tolist() == [0.0, 0.5, 1.0]


def test_the_probability_of_improvement_is_that_of_rliable_and_scipy() -> None:
    # rliable 1.2.0: metrics.probability_of_improvement(X.T, Y.T); ties count half there too.
    assert probability_of_improvement(X, Y).mean == pytest.approx(0.608333, abs=1e-6)
    shares = [stats.mannwhitneyu(ours, theirs).statistic / 20.0 for ours, theirs in zip(X, Y, strict=True)]
    assert probability_of_improvement(X, Y).mean == pytest.approx(np.mean(shares))
    assert probability_of_improvement([[1.0, 2.0]], [[2.0, 0.0]]).mean == 0.625


def test_the_ends_are_as_far_as_their_own_errors_allow() -> None:
    estimate = probability_of_improvement([[5.0, 3.0, 8.0, 9.0]], [[1.0, 4.0, 2.0]])
    for end in (estimate.lower, estimate.upper):
        # Hanley & McNeil's variance, with both numbers of runs replaced by their mean (Newcombe's method 5).
        q1, q2 = end / (2.0 - end), 2.0 * end**2 / (1.0 + end)
        square = (end * (1.0 - end) + 2.5 * (q1 - end**2) + 2.5 * (q2 - end**2)) / 12.0
        assert abs(end - estimate.mean) == pytest.approx(stats.norm.ppf(0.975) * math.sqrt(square))
    other_way = probability_of_improvement([[1.0, 4.0, 2.0]], [[5.0, 3.0, 8.0, 9.0]])
    assert (1.0 - other_way.upper, 1.0 - other_way.lower) == pytest.approx((estimate.lower, estimate.upper))


def test_all_above_all_is_no_proof() -> None:
    estimate = probability_of_improvement([[5.0] * 5], [[1.0] * 5])
    assert (estimate.mean, estimate.upper) == (1.0, 1.0)
    assert 0.5 < estimate.lower < 0.8
    same = probability_of_improvement([[5.0] * 5], [[5.0] * 5])
    assert same.mean == 0.5
    assert same.lower < 0.3
    assert same.upper > 0.7
    assert probability_of_improvement([[5.0]], [[1.0]]).lower < 0.4


@pytest.mark.parametrize("tasks", [1, 4])
@pytest.mark.parametrize("runs", [5, 10])
def test_probabilities_of_improvement_cover_the_truth(tasks: int, runs: int) -> None:
    rng = np.random.default_rng(2)
    truth = stats.norm.cdf(math.sqrt(0.5))
    held = 0
    for _ in range(400):
        left = list(1.0 + rng.standard_normal((tasks, runs)))
        estimate = probability_of_improvement(left, list(rng.standard_normal((tasks, runs))))
        held += estimate.lower <= truth <= estimate.upper
    assert 0.92 <= held / 400 <= 0.98


def test_bad_values_of_tasks() -> None:
    rng = np.random.default_rng(0)
    for bad, message in (([], "is empty"), ([[]], "non-empty"), ([[1.0], [math.nan]], r"\[1\]: 1 of 1 values")):
        with pytest.raises(ValueError, match=message):
            iqm_with_ci(bad, rng=rng)
        with pytest.raises(ValueError, match=message):
            performance_profile(bad, [0.0])
        with pytest.raises(ValueError, match=message):
            probability_of_improvement(bad, [[1.0], [2.0]])
    with pytest.raises(ValueError, match="cannot compare 1 tasks with 2"):
        probability_of_improvement([[1.0]], [[1.0], [2.0]])
    with pytest.raises(ValueError, match="thresholds"):
        performance_profile([[1.0]], [])
    for level in (0.0, 1.0, 95.0, math.nan):
        with pytest.raises(ValueError, match="level"):
            performance_profile([[1.0]], [0.0], level=level)
        with pytest.raises(ValueError, match="level"):
            probability_of_improvement([[1.0]], [[0.0]], level=level)
        with pytest.raises(ValueError, match="level"):
            iqm_with_ci([[1.0, 2.0]], rng=rng, level=level)


def test_thousands_of_tasks() -> None:
    scores = np.random.default_rng(0).uniform(size=(5_000, 3))
    assert probability_of_improvement(list(scores), list(scores)).mean == pytest.approx(0.5)
    assert iqm_with_ci(list(scores), rng=np.random.default_rng(0), num_resamples=20).num_values == 15_000
    assert performance_profile(list(scores), [0.5]).shares == pytest.approx([0.5], abs=0.02)

"""Survival curves of env steps to a threshold: against lifelines and SciPy."""

import math

import numpy as np
import pytest
from scipy import stats

from analysis.statistics import median_steps, steps_to_threshold

REACHED = [5000, 8000, 8000, 12000, None, 20000, None, 30000]
LAST = [40000, 40000, 40000, 40000, 10000, 40000, 25000, 40000]


def test_curve_and_intervals_are_those_of_lifelines() -> None:
    # lifelines 0.30.3: KaplanMeierFitter().fit(steps, observed), survival_function_ and confidence_interval_.
    curve = steps_to_threshold(REACHED, LAST)
    assert curve.steps.tolist() == [5000.0, 8000.0, 12000.0, 20000.0, 30000.0]
    assert curve.shares == pytest.approx([0.875, 0.625, 0.46875, 0.3125, 0.0])
    assert curve.lower == pytest.approx([0.387000, 0.229333, 0.119929, 0.047849, 0.0], abs=1e-6)
    assert curve.upper[:4] == pytest.approx([0.981393, 0.860698, 0.762856, 0.640770], abs=1e-6)
    # Where nobody is left lifelines says 0 to 0, as if that were certain.
    assert curve.upper[4] == curve.upper[3]
    assert curve.num_at_risk.tolist() == [8, 7, 4, 3, 1]
    assert curve.num_reached.tolist() == [1, 2, 1, 1, 1]
    assert (curve.median, curve.median_interval) == (12000.0, (5000.0, None))


@pytest.mark.filterwarnings("ignore:The confidence interval is undefined")
def test_the_curve_is_scipys() -> None:
    rng = np.random.default_rng(0)
    # In tens of steps, so that trials end and reach the threshold at the same ones.
    steps, last = rng.integers(1, 40, size=60) * 10.0, rng.integers(1, 60, size=60) * 10.0
    reached = [float(step) if step <= end else None for step, end in zip(steps, last, strict=True)]
    curve = steps_to_threshold(reached, last.tolist())
    censored = stats.CensoredData(
        uncensored=[step for step in reached if step is not None],
        right=[end for step, end in zip(reached, last, strict=True) if step is None],
    )
    expected = stats.ecdf(censored).sf
    assert curve.shares == pytest.approx(expected.evaluate(curve.steps))
    ends = expected.confidence_interval(0.9, method="log-log")
    curve = steps_to_threshold(reached, last.tolist(), level=0.9)
    known = curve.shares > 0.0
    assert curve.lower[known] == pytest.approx(ends.low.evaluate(curve.steps)[known])
    assert curve.upper[known] == pytest.approx(ends.high.evaluate(curve.steps)[known])


def test_a_trial_that_ends_early_is_not_one_that_never_would() -> None:
    reached, last = [1000, None, None, 9000], [10000, 500, 500, 10000]
    assert median_steps(reached) is None
    assert steps_to_threshold(reached, last).median == 1000.0


def test_a_threshold_that_nobody_or_one_reached() -> None:
    nobody = steps_to_threshold([None, None], [1000, 2000])
    assert (nobody.steps.size, nobody.median, nobody.median_interval, nobody.num_trials) == (0, None, (None, None), 2)
    one = steps_to_threshold([0], [0])
    assert (one.steps.tolist(), one.shares.tolist(), one.median) == ([0.0], [0.0], 0.0)
    assert (one.lower.tolist(), one.upper.tolist()) == ([0.0], [1.0])
    assert one.median_interval == (0.0, None)
    half = steps_to_threshold([1000, None], [5000, 5000])
    assert (half.shares.tolist(), half.median) == ([0.5], 1000.0)


@pytest.mark.parametrize(
    ("reached", "last", "message"),
    [
        ([], [], "num_env_steps: expected a 1-D, non-empty"),
        ([None], [1, 2], "1 trials in reached, but 2 in num_env_steps"),
        ([math.nan], [1], "reached: 1 of 1 values are not finite"),
        ([None], [math.inf], "num_env_steps: 1 of 1 values are not finite"),
        ([-1], [1], "negative"),
        ([1, 3], [5, 2], "trial 1 reached the threshold at 3, after its last 2"),
    ],
)
def test_bad_env_steps(reached: list[float | None], last: list[float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        steps_to_threshold(reached, last)


def test_a_level_that_is_none() -> None:
    with pytest.raises(ValueError, match="level"):
        steps_to_threshold([1], [1], level=2.0)


def test_thousands_of_trials() -> None:
    curve = steps_to_threshold([float(step) for step in range(1, 5_001)], [5_000.0] * 5_000)
    assert curve.median == 2_500.0
    assert (np.diff(curve.shares) < 0.0).all()

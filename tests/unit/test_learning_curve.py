"""The area under a learning curve, and its collapse."""

import math

import numpy as np
import pytest
from scipy import integrate

from analysis.statistics import area_under_curve, has_collapsed, share_lost


def test_the_area_is_scipys() -> None:
    rng = np.random.default_rng(0)
    steps, returns = np.cumsum(rng.uniform(1.0, 100.0, size=30)), rng.normal(size=30)
    steps[0] = 0.0
    expected = integrate.trapezoid(returns, steps) / steps[-1]
    assert area_under_curve(steps, returns) == pytest.approx(expected)
    assert area_under_curve(10.0 * steps, returns) == pytest.approx(expected)  # whatever the steps are counted in


def test_a_missing_start_is_level_or_given() -> None:
    assert area_under_curve([100.0, 200.0], [10.0, 20.0]) == pytest.approx((10.0 + 15.0) / 2.0)
    assert area_under_curve([100.0, 200.0], [10.0, 20.0], initial_return=0.0) == pytest.approx((5.0 + 15.0) / 2.0)
    assert area_under_curve([0.0, 200.0], [10.0, 20.0], initial_return=-500.0) == pytest.approx(15.0)  # is known


def test_the_end_is_held_or_cut() -> None:
    assert area_under_curve([0.0, 100.0], [0.0, 10.0], num_env_steps=200.0) == pytest.approx((5.0 + 10.0) / 2.0)
    assert area_under_curve([0.0, 100.0], [0.0, 10.0], num_env_steps=50.0) == pytest.approx(2.5)
    assert area_under_curve([100.0, 200.0], [4.0, 9.0], num_env_steps=50.0) == pytest.approx(4.0)


def test_a_single_evaluation() -> None:
    assert area_under_curve([0.0], [3.0]) == 3.0
    assert area_under_curve([500.0], [3.0]) == 3.0
    assert area_under_curve([500.0], [3.0], initial_return=1.0) == 2.0
    assert area_under_curve([0.0], [3.0], num_env_steps=10.0) == 3.0


@pytest.mark.parametrize(
    ("steps", "returns", "message"),
    [
        ([], [], "env_steps: expected a 1-D, non-empty"),
        ([1.0], [1.0, 2.0], "1 env steps, but 2 returns"),
        ([1.0, 1.0], [1.0, 2.0], "don't increase"),
        ([2.0, 1.0], [1.0, 2.0], "don't increase"),
        ([-1.0, 1.0], [1.0, 2.0], "negative"),
        ([1.0, 2.0], [1.0, math.nan], "returns: 1 of 2 values are not finite"),
    ],
)
def test_bad_curves(steps: list[float], returns: list[float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        area_under_curve(steps, returns)


@pytest.mark.parametrize("end", [0.0, -1.0, math.nan])
def test_an_area_over_no_env_steps(end: float) -> None:
    with pytest.raises(ValueError, match=r"over|not finite"):
        area_under_curve([1.0, 2.0], [1.0, 2.0], num_env_steps=end)


def test_a_start_that_is_none() -> None:
    with pytest.raises(ValueError, match="initial_return"):
        area_under_curve([1.0, 2.0], [1.0, 2.0], initial_return=math.inf)


def test_what_a_trial_lost() -> None:
    returns = [20.0, 120.0, 220.0, 170.0, 70.0]
    assert share_lost(returns) == pytest.approx(0.75)
    assert share_lost(returns, num_last=2) == pytest.approx(0.5)
    assert share_lost(returns, baseline=-80.0) == pytest.approx(0.5)
    assert share_lost([0.0, 10.0, -5.0]) == pytest.approx(1.5)
    assert share_lost([0.0, 5.0, 10.0]) == 0.0
    assert [has_collapsed(returns, share=share) for share in (0.5, 0.74, 0.75, 1.0)] == [True, True, False, False]
    assert has_collapsed(returns) is True
    assert has_collapsed(returns, baseline=-80.0) is False  # not more than a half


def test_what_never_was_learnt_cant_be_lost() -> None:
    for returns in ([3.0], [3.0, 3.0], [3.0, 1.0]):
        assert share_lost(returns) is None
        assert has_collapsed(returns) is None
    assert has_collapsed([3.0, 1.0], baseline=0.0) is True
    assert has_collapsed([3.0, 1.0], baseline=5.0) is None


def test_bad_returns() -> None:
    with pytest.raises(ValueError, match="returns: expected a 1-D, non-empty"):
        share_lost([])
    with pytest.raises(ValueError, match="not finite"):
        has_collapsed([1.0, math.nan])
    with pytest.raises(ValueError, match="baseline"):
        share_lost([1.0], baseline=math.nan)
    for num_last in (0, 3):
        with pytest.raises(ValueError, match=f"num_last {num_last} is not from 1 to 2"):
            share_lost([1.0, 2.0], num_last=num_last)
    for share in (0.0, 1.1, math.nan):
        with pytest.raises(ValueError, match="share"):
            has_collapsed([1.0, 2.0], share=share)

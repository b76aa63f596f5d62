"""Ends of the studentized bootstrap where resamples have no spread, or none but one value."""

from __future__ import annotations

import math

import numpy as np
import pytest

from analysis.statistics import bootstrap_t_interval
from analysis.statistics.few_seeds import _pivots


@pytest.mark.parametrize("values", [[1.0, 2.0, 3.0], [0.1, 0.2, 0.3]])
def test_three_different_scores_set_no_bound_and_no_end_is_made_up(values: list[float]) -> None:
    # One resample in 27 is of the mean alone, one of the least and one of the greatest: more than 2.5 % each. The mean
    # of three times 0.1 is not 0.1, so that such a resample seems to have a spread.
    found = bootstrap_t_interval(values, rng=np.random.default_rng(0))
    assert (found.lower, found.upper) == (-math.inf, math.inf)
    assert "set no bound" in found.note


def test_one_end_without_a_bound_is_said() -> None:
    # A third of the resamples are of 1 alone, and hardly any of 5.
    found = bootstrap_t_interval([1.0, 1.0, 1.0, 1.0, 5.0], rng=np.random.default_rng(0))
    assert math.isinf(found.upper)
    assert math.isfinite(found.lower)
    assert "set no bound" in found.note


def test_ends_are_the_nearest_resamples_outwards() -> None:
    values = np.array([1.0, 2.0, 4.0, 8.0, 9.0, 7.0])
    error = values.std(ddof=1) / math.sqrt(len(values))
    pivots = np.sort(_pivots(values, np.random.default_rng(0), 31))
    # 2.5 % of the way through 31 resamples is at 0.75, and 97.5 % at 29.25: outwards are the first and the last.
    assert pivots[0] < pivots[1] < pivots[29] < pivots[30] < math.inf
    found = bootstrap_t_interval(values, rng=np.random.default_rng(0), num_resamples=31)
    ends = (values.mean() - pivots[30] * error, values.mean() - pivots[0] * error)
    assert (found.lower, found.upper) == pytest.approx(ends)

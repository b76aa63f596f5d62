"""The mean of one policy over its episodes, with an interval that holds for few of them too."""

from __future__ import annotations

import numpy as np

from analysis.statistics.estimate import Estimate, Values, finite_1d
from analysis.statistics.few_seeds import t_interval
from analysis.statistics.means import mean_with_ci

_MIN_RESAMPLED = 20


def episodes_interval(returns: Values, *, rng: np.random.Generator) -> Estimate:
    """Return the mean with its 95 % interval: Student's of fewer than 20 episodes, the percentile bootstrap's of more.

    The latter never goes beyond the returns that there are: of 2, 3, 5 and 10 normal ones it covers the truth in 51,
    75, 83 and 89 % of all cases, and Student's in 95. Of twenty they differ little, and of many the bootstrap
    needs no normal returns.

    Args:
        returns: Those of the episodes, shape (n,), n at least 2.
        rng: Draws the resamples; the same state gives the same interval.

    Raises:
        ValueError: There are fewer than two, the array is not 1-D, or one is not finite.
    """
    array = finite_1d(returns)
    return t_interval(array) if array.size < _MIN_RESAMPLED else mean_with_ci(array, rng=rng)

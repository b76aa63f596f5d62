"""What a model promises of a point: how much better than the best its score is expected to be."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def log_expected_improvement(mean: Floats, deviation: Floats, best: float) -> Floats:
    """Return the logarithm of how much better than the best scores are expected to be, where worse ones count as equal.

    The logarithm also tells apart what promises nearly nothing (Ament et al. 2023, "Unexpected Improvements to Expected
    Improvement for Bayesian Optimization").

    Args:
        mean: What is expected of each point, shape (num_points,).
        deviation: How far off that may be, above 0, of the same shape.
        best: What is expected of the best point that was tried.
    """
    from scipy.special import erfcx, log_ndtr

    u = (mean - best) / deviation
    density = -0.5 * u**2 - 0.5 * math.log(2.0 * math.pi)
    # h(u) = density(u) + u cumulative(u); below -1 written such that nothing cancels.
    low = np.minimum(u, -1.0)
    ratio = np.sqrt(np.pi / 2.0) * erfcx(-low / math.sqrt(2.0)) * np.abs(low)
    below = density + np.log(np.maximum(1.0 - ratio, 1.0 / (2.0 + low**2) / 2.0))
    high = np.maximum(u, -1.0)
    above = np.log(np.exp(-0.5 * high**2) / math.sqrt(2.0 * math.pi) + high * np.exp(log_ndtr(high)))
    improvement: Floats = np.log(deviation) + np.where(u < -1.0, below, above)
    return improvement

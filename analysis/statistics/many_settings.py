"""Intervals over training seeds for many settings at once, which learn from each other how much seeds differ.

With few seeds a setting's own variance is badly known: of five runs of a setting that solves a task in 70 % of them,
17 % of the time all five solve it, and their variance is zero. The sweep has seen other settings collapse, though. A
*moderated* variance is a weighted mean of the setting's own and of what all settings say:

    v = (d0 s0^2 + d s^2) / (d0 + d),   with d = n - 1, and d0 + d degrees of freedom

where s0^2, d0 are the prior that all settings together give.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.estimate import (
    Estimate,
    Values,
    check_level,
    exponent_of,
    finite_arrays,
    mean_of,
    variance,
)
from analysis.statistics.student_t import t_quantile

_BLOCK_VALUES = 2_000_000


@dataclass(frozen=True)
class ModeratedMeans:
    """The means of K settings over their training seeds, with what is known of their errors."""

    means: NDArray[np.float64]
    """Shape (K,)."""
    standard_errors: NDArray[np.float64]
    """Shape (K,), from the moderated variances; all 0 if in no setting any two seeds differ."""
    dfs: NDArray[np.float64]
    """Degrees of freedom of the moderated variances, shape (K,)."""
    num_seeds: NDArray[np.int64]
    """Shape (K,)."""
    own_variances: NDArray[np.float64]
    """The variance of each setting's own seeds, shape (K,); NaN of a setting with one seed."""
    common_variance: bool
    """Whether all settings are taken to have one variance, as they differ no more than chance would make them."""

    def relative_errors(self, rng: np.random.Generator, num_draws: int) -> NDArray[np.float64]:
        """Draw ratios of the true to the estimated standard error, sqrt(df / chi^2), shape (num_draws, K)."""
        size = (num_draws, 1 if self.common_variance else self.means.size)
        dfs = self.dfs[:1] if self.common_variance else self.dfs
        ratios = np.sqrt(dfs / rng.chisquare(dfs, size=size))
        return np.broadcast_to(ratios, (num_draws, self.means.size))

    def blocks(self, num_draws: int) -> list[int]:
        """Return how many draws to make at a time so that memory stays small."""
        block = max(1, _BLOCK_VALUES // self.means.size)
        return [min(block, num_draws - start) for start in range(0, num_draws, block)]


def moderated_means(settings: Sequence[Values]) -> ModeratedMeans:
    """Return the means of all settings and their standard errors, with variances moderated over settings.

    The model is that of limma: the true variances of settings come from a scaled inverse chi^2 distribution, so that
    s^2 / s0^2 has an F distribution. Its parameters are fitted by the first two moments of the s^2, weighted by their
    degrees of freedom, not by those of their logarithms, as in limma: seeds that all reach the same score have a
    variance of zero, and its logarithm would decide everything. By moments, such settings get a share of the mean
    variance of all. d0 is at least 4, as the inverse chi^2 distribution has no variance below.

    Args:
        settings: For each setting one score a training seed; they may differ in number. A setting with one seed has the
            prior variance.

    Raises:
        ValueError: There are no settings; one has no score or one that is not finite; none has two seeds, so that
            nothing is known of how seeds differ; or values are so large that their squares are not finite.

    Source:
        Smyth 2004, "Linear Models and Empirical Bayes Methods for Assessing Differential Expression", sections 3 and 6;
        Wright & Simon 2003, "A random variance model", for the marginal F distribution.
    """
    arrays = finite_arrays(settings, "settings")
    sizes = np.array([array.size for array in arrays])
    if sizes.max() < 2:
        raise ValueError("no setting has two seeds, so nothing is known of how seeds differ")
    means = np.array([mean_of(array) for array in arrays])
    # In units of a power of two, by which nothing is rounded, as the squares of small scores are lost.
    exponent = min(0, exponent_of(np.concatenate(arrays)))
    units = [np.ldexp(array, -exponent) for array in arrays]
    with np.errstate(over="ignore"):
        own = np.array([variance(array) if array.size > 1 else np.nan for array in units])
    prior_df, prior_variance = _prior(own[sizes > 1], sizes[sizes > 1] - 1.0)
    own_df = sizes - 1.0
    known = np.where(sizes > 1, own, 0.0)
    if math.isinf(prior_df):
        moderated = np.full(sizes.size, prior_variance)
    else:
        moderated = (prior_df * prior_variance + own_df * known) / (prior_df + own_df)
    # No more degrees of freedom than all settings have together.
    dfs = np.minimum(prior_df + own_df, own_df.sum())
    errors = np.ldexp(np.sqrt(moderated / sizes), exponent)
    return ModeratedMeans(means, errors, dfs, sizes, np.ldexp(own, 2 * exponent), math.isinf(prior_df))


def seeds_differ(settings: Sequence[Values]) -> bool:
    """Whether in any setting two seeds differ; where not, nothing is known of how much they may.

    Raises:
        ValueError: There are no settings, or one has no score or one that is not finite.
    """
    return any(array.min() != array.max() for array in finite_arrays(settings, "settings"))


def tell_the_best(settings: Sequence[Values]) -> bool:
    """Whether scores say how probably each setting is the best: seeds differ, or there is nothing but one score.

    Of one score for all seeds of all settings each is as probably the best. Of several, where no two seeds of a setting
    differ, nobody knows whether settings differ or seeds would.

    Raises:
        ValueError: In the cases of `seeds_differ`.
    """
    return seeds_differ(settings) or len({float(score) for scores in settings for score in scores}) == 1


def seed_intervals(
    settings: Sequence[Values],
    *,
    level: float = 0.95,
    bounds: tuple[float, float] = (-math.inf, math.inf),
) -> list[Estimate]:
    """Return for each setting its mean over training seeds with a moderated t interval. Nothing is resampled.

    This is the default of all intervals over seeds. Over the settings of a sweep it covers what it states, also where
    runs either solve a task or collapse: 92 to 98 % for a stated 95 %, with five or ten seeds a setting and ten
    settings or more. It doesn't where all settings collapse, but so seldom that hardly any was seen to, and with two to
    five settings it covers 3 to 10 points less where runs are skewed (decision 28 has the figures). Of one setting
    alone it is `t_interval`.

    Args:
        settings: For each setting one score a training seed; they may differ in number.
        level: The share of intervals that shall cover the truth, averaged over the settings, in (0, 1).
        bounds: The lowest and the highest score there can be, if known; intervals are cut off there.

    Returns:
        One estimate a setting, in the order given. Its note says where the width is that of other settings: of a single
        seed, or of seeds that all score the same. If in no setting any two seeds differ, intervals have no width, and
        the note says that this isn't to be believed.

    Raises:
        ValueError: In the cases of `moderated_means`; the level is outside (0, 1); or a mean is outside the bounds.

    Source:
        Smyth 2004 (see `moderated_means`), section 4.
    """
    check_level(level)
    fit = moderated_means(settings)
    low, high = bounds
    if not (low <= fit.means.min() and fit.means.max() <= high):
        raise ValueError(f"means from {fit.means.min():g} to {fit.means.max():g} are not within {low:g} and {high:g}")
    quantiles = np.array([t_quantile((1.0 + level) / 2.0, float(df)) for df in fit.dfs])
    halves = quantiles * fit.standard_errors
    return [
        Estimate(float(mean), max(float(mean - half), low), min(float(mean + half), high), int(size), note)
        for mean, half, size, note in zip(fit.means, halves, fit.num_seeds, _notes(fit), strict=True)
    ]


def known_intervals(settings: Sequence[Values]) -> list[Estimate | None]:
    """Return `seed_intervals`, but None for each setting where nothing is known of how much seeds differ.

    That is where no setting has two seeds, no two seeds of a setting differ, or scores are too large to be squared.
    """
    try:
        return list(seed_intervals(settings)) if seeds_differ(settings) else [None] * len(settings)
    except ValueError:
        return [None] * len(settings)


def _prior(variances: NDArray[np.float64], dfs: NDArray[np.float64]) -> tuple[float, float]:
    """Return d0, s0^2; d0 is infinite if the variances differ no more than chance would make them.

    With s^2 = sigma^2 chi^2_d / d the mean of s^2 is that of sigma^2, and that of s^4 / (1 + 2 / d) is that of sigma^4.
    A scaled inverse chi^2 has mean d0 s0^2 / (d0 - 2) and squared coefficient of variation 2 / (d0 - 4).
    """
    pooled = float(np.average(variances, weights=dfs))
    if not math.isfinite(pooled):
        raise ValueError("the values are so large that their squares are not finite")
    if pooled == 0.0:
        return math.inf, 0.0
    spread = float(np.average((variances / pooled) ** 2 / (1.0 + 2.0 / dfs), weights=dfs)) - 1.0
    if spread <= 0.0:
        return math.inf, pooled
    prior_df = 4.0 + 2.0 / spread
    return prior_df, pooled * (prior_df - 2.0) / prior_df


def _notes(fit: ModeratedMeans) -> list[str]:
    if fit.standard_errors.max() == 0.0:
        return ["in no setting any two seeds differ: how much they may is not known"] * fit.means.size
    return [
        "one seed: the width is that of other settings"
        if size == 1
        else f"its {size} seeds score the same: the width is that of other settings"
        if own == 0.0
        else ""
        for size, own in zip(fit.num_seeds, fit.own_variances, strict=True)
    ]

"""Statistics for reports on sweeps: few seeds, skewed or two-peaked returns, many settings.

The meaning of an interval depends on what varies. An interval over *training seeds* says how another training run of
the setting would do; it is made of one score a seed. One over *episodes* of one policy says how that policy would do in
other episodes, which says nothing about training it again.

| question | function |
|---|---|
| the mean over seeds, of each setting of a sweep | `seed_intervals`, the default: it covers the truth best |
| the same of one setting by itself | `t_interval`, `bootstrap_t_interval` |
| the mean over episodes of one policy | `episodes_interval`; `mean_with_ci`, `paired_difference` of hundreds |
| which setting is best, how surely | `probability_of_being_best` |
| which settings can't be told apart | `tie_groups` |
| one sweep, several tasks | `iqm_with_ci`, `performance_profile` |
| are runs of X better than runs of Y | `probability_of_improvement` |
| env steps to a threshold that some never reach | `steps_to_threshold`, `median_steps` |
| one trial's learning curve | `area_under_curve`, `has_collapsed` |

Scores are better the higher they are. What the intervals cover, measured, is in decision 28.
"""

from analysis.statistics.comparisons import Profile, iqm_with_ci, performance_profile, probability_of_improvement
from analysis.statistics.episodes import episodes_interval
from analysis.statistics.estimate import Estimate
from analysis.statistics.few_seeds import bootstrap_t_interval, t_interval
from analysis.statistics.learning_curve import area_under_curve, has_collapsed, share_lost
from analysis.statistics.many_settings import (
    ModeratedMeans,
    known_intervals,
    moderated_means,
    seed_intervals,
    seeds_differ,
    tell_the_best,
)
from analysis.statistics.means import (
    MIN_SEEDS_FOR_INTERVAL,
    iqm,
    mean_with_ci,
    median_steps,
    paired_difference,
    small_sample_note,
)
from analysis.statistics.ranking import TieGroups, probability_of_being_best, tie_groups
from analysis.statistics.student_t import t_quantile
from analysis.statistics.survival import SurvivalCurve, steps_to_threshold

__all__ = [
    "MIN_SEEDS_FOR_INTERVAL",
    "Estimate",
    "ModeratedMeans",
    "Profile",
    "SurvivalCurve",
    "TieGroups",
    "area_under_curve",
    "bootstrap_t_interval",
    "episodes_interval",
    "has_collapsed",
    "iqm",
    "iqm_with_ci",
    "known_intervals",
    "mean_with_ci",
    "median_steps",
    "moderated_means",
    "paired_difference",
    "performance_profile",
    "probability_of_being_best",
    "probability_of_improvement",
    "seed_intervals",
    "seeds_differ",
    "share_lost",
    "small_sample_note",
    "steps_to_threshold",
    "t_interval",
    "t_quantile",
    "tell_the_best",
    "tie_groups",
]

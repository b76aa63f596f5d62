"""How long more trainings of a sweep take, by what those so far took."""

from __future__ import annotations

import statistics

from analysis.core_seconds import busy_cores
from analysis.page.source import Source
from analysis.racing import Race
from analysis.wording import duration

TOP, SEEDS = 5, 5
"""What `tune-jobs replicate` has by default: how many settings race, and for how many more seeds at most."""


def takes(source: Source, num_trainings: int) -> str:
    """Estimate how long a number of trainings takes; empty: that is not known.

    They cost what the trials of the sweep cost in the mean, as many cores are busy as were, and starting and finishing
    takes as long as it did.
    """
    costs, busy_ones = source.core_seconds, busy_cores(source.trials, source.core_seconds)
    if not busy_ones or num_trainings < 1:
        return ""
    cores = max(busy_ones, 1.0)
    training = num_trainings * statistics.fmean(costs.values()) / cores
    others = max(0.0, source.sweep.run_time_s - sum(costs.values()) / busy_ones) / (1 + len(source.sweep.replications))
    return duration(training + others, tenths=False, none="")


def replicate_takes(source: Source) -> str:
    """Estimate how long `tune-jobs replicate` takes; empty: that is not known."""
    settings = source.settings
    if settings is None:
        return ""
    return takes(source, Race(tuple(range(min(TOP, settings.num_settings))), SEEDS).max_trainings)

"""Import what a sweep needs next while this process waits for others.

By name, as what drives a sweep is imported by what follows its trials.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
from collections.abc import Callable

from analysis.records import TrialRecord
from tune_jobs.sweeps.monitor import SweepMonitor

_FOLLOWS = ("tune_jobs.sweeps.conclude", "tune_jobs.sweeps.filming", "analysis.report", "policies.foreign_code")


def import_what_runs_trials() -> None:
    """Import Ray Tune and what is built on it. What can't be imported is an error where it is needed."""
    _import("tune_jobs.ray_tune.run_trials")


def importing_what_follows(monitor: SweepMonitor) -> Callable[[TrialRecord], None]:
    """Return what tells a monitor of trials, and imports what follows them once one has reported.

    An upgrade of tune-jobs while they train replaces its files: what is imported after it need not fit what is loaded.
    Nobody waits for this process then, as before the first report.
    """

    def told(record: TrialRecord) -> None:
        monitor.update(record)
        if monitor.reported_at is not None:
            _import_what_follows()

    return told


@functools.cache
def _import_what_follows() -> None:
    for name in _FOLLOWS:
        _import(name)


def _import(name: str) -> None:
    with contextlib.suppress(Exception):
        importlib.import_module(name)

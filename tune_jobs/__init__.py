"""Hyperparameter search for reinforcement learning: one sweep file, one call, the best policy on video.

The names below are the Python API. They are imported when they are first used, so that `import tune_jobs` is instant
and needs neither ray nor torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from tune_jobs.process import own_packages as _own_packages

if TYPE_CHECKING:
    from policies.envs.modules import allow_modules as allow_modules
    from policies.errors import TuneJobsError as TuneJobsError
    from tune_jobs.spec.file import list_presets as list_presets
    from tune_jobs.spec.file import load_spec as load_spec
    from tune_jobs.spec.sweep_spec import SweepSpec as SweepSpec
    from tune_jobs.sweeps.interrupted import SweepInterrupted as SweepInterrupted
    from tune_jobs.sweeps.loading import load_policy as load_policy
    from tune_jobs.sweeps.verbs import CreatedSweep as CreatedSweep
    from tune_jobs.sweeps.verbs import SweepResult as SweepResult
    from tune_jobs.sweeps.verbs import SweepStatus as SweepStatus
    from tune_jobs.sweeps.verbs import best as best
    from tune_jobs.sweeps.verbs import compare as compare
    from tune_jobs.sweeps.verbs import create as create
    from tune_jobs.sweeps.verbs import dataframe as dataframe
    from tune_jobs.sweeps.verbs import drive as drive
    from tune_jobs.sweeps.verbs import evaluate as evaluate
    from tune_jobs.sweeps.verbs import export as export
    from tune_jobs.sweeps.verbs import extend as extend
    from tune_jobs.sweeps.verbs import figure as figure
    from tune_jobs.sweeps.verbs import importance as importance
    from tune_jobs.sweeps.verbs import inject as inject
    from tune_jobs.sweeps.verbs import launch as launch
    from tune_jobs.sweeps.verbs import list_sweeps as list_sweeps
    from tune_jobs.sweeps.verbs import replicate as replicate
    from tune_jobs.sweeps.verbs import report as report
    from tune_jobs.sweeps.verbs import reproduce as reproduce
    from tune_jobs.sweeps.verbs import restore as restore
    from tune_jobs.sweeps.verbs import resume as resume
    from tune_jobs.sweeps.verbs import status as status
    from tune_jobs.sweeps.verbs import stop as stop
    from tune_jobs.sweeps.verbs import study as study
    from tune_jobs.sweeps.verbs import trials as trials
    from tune_jobs.sweeps.verbs import video as video

_SWEEPS = (
    "CreatedSweep", "SweepResult", "SweepStatus", "best", "compare", "create", "dataframe", "drive", "evaluate",
    "export", "extend", "figure", "importance", "inject", "launch", "list_sweeps", "replicate", "report", "reproduce",
    "restore", "resume", "status", "stop", "study", "trials", "video",
)  # fmt: skip
_HOME = {
    "TuneJobsError": "policies.errors",
    "allow_modules": "policies.envs.modules",
    "load_policy": "tune_jobs.sweeps.loading",
    "SweepInterrupted": "tune_jobs.sweeps.interrupted",
    "SweepSpec": "tune_jobs.spec.sweep_spec",
    "list_presets": "tune_jobs.spec.file",
    "load_spec": "tune_jobs.spec.file",
    **dict.fromkeys(_SWEEPS, "tune_jobs.sweeps.verbs"),
}

__all__ = sorted(_HOME)  # noqa: PLE0605 (as written above)

# This comes before anything of policies or analysis is imported.
_own_packages.install()


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'tune_jobs' has no attribute {name!r}; it has {sorted(_HOME)}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])

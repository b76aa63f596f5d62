"""What a report is made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from analysis import report_data
from analysis.answers import nothing_learned
from analysis.best_records import BestRecord, SettingsRecord
from analysis.core_seconds import core_seconds
from analysis.importance import WhatMattered, what_mattered
from analysis.objectives import SettingScores, rank_settings
from analysis.plot_style import numeric_names
from analysis.records import IterationRecord, SweepRecord, TrialRecord
from analysis.tables import cell_value, env_steps_to
from analysis.wording import number, shown_path


@dataclass(frozen=True)
class Source:
    """The data that a report is made from; every section of the page is a function of it."""

    place: str
    """The sweep's folder or URL, as the report names it."""
    sweep: SweepRecord
    trials: Sequence[TrialRecord]
    results: Mapping[str, Sequence[IterationRecord]]
    """Iterations by trial id, oldest first; a trial may have none."""
    best: BestRecord | None
    goal: float | None
    """The return that counts as solved; None: there is none."""
    why_no_best: tuple[str, str] | None = None
    """Why there is no winner, and what to do; None: the reason is found in the trials."""
    settings: SettingsRecord | None = None
    """The settings, ranked; None: nothing can be said of them."""

    @cached_property
    def importance(self) -> WhatMattered:
        """What mattered; it takes a second or so, and more than one section uses it."""
        return what_mattered(self.sweep, self.trials, self.results, threshold=self.goal)

    @property
    def axis(self) -> str | None:
        """The searched number on the horizontal axis."""
        return next(iter(numeric_names(self.trials)), None)

    @property
    def winner(self) -> str | None:
        """Trial id of the confirmed winner."""
        return None if self.best is None else self.best.checkpoint.trial_id

    @property
    def path(self) -> str:
        """The sweep's place as a user would type it."""
        return shown_path(self.place)

    @property
    def is_trained(self) -> bool:
        """Whether the sweep's policies learn, which those of baselines don't."""
        return report_data.is_trained(self.sweep)

    @cached_property
    def nothing_learned(self) -> str:
        """That training has not led beyond random play, as a sentence; empty: it has, as far as is known."""
        return nothing_learned(self.best) if self.is_trained and self.best is not None else ""

    @property
    def is_population(self) -> bool:
        """Whether trials change their hyperparameters while they train, so that none has a setting."""
        return self.sweep.is_population

    @property
    def cores_per_process(self) -> float:
        """How many cores a process that trains has: those that the sweep file gives a trial."""
        resources = self.sweep.section("resources")
        return float(resources.get("num_cpus") or 1 + int(resources.get("num_env_runners") or 0))

    @cached_property
    def core_seconds(self) -> dict[str, float]:
        """The core-seconds of each trial of which they are known, see `analysis.core_seconds`."""
        return core_seconds(self.trials, self.cores_per_process)

    @cached_property
    def ranked(self) -> list[SettingScores]:
        """All settings with their scores, best first, where `settings` lists the leading ones."""
        settings, cap = self.settings, self.sweep.section("stop").get("num_env_steps")
        if settings is None:
            return []
        return rank_settings(
            self.trials, self.results, settings.objective,
            num_env_steps=int(cap or max((trial.num_env_steps for trial in self.trials), default=0)),
            num_iterations=self.sweep.max_iterations, threshold=settings.threshold,
        )  # fmt: skip

    def env_steps_to_goal(self, trial_id: str, goal: float | None) -> int | None:
        """Return the env steps until a trial's training return reached a goal; None: it never did."""
        return env_steps_to(goal, self.results.get(trial_id, ()))


def point_pairs(point: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the names of a point's values and their texts."""
    return [(name, number(cell_value(value))) for name, value in point.items()]


def point_text(point: Mapping[str, Any]) -> str:
    """Return a point in words: "hidden_sizes 64, activation relu"."""
    return ", ".join(f"{name} {text}" for name, text in point_pairs(point))

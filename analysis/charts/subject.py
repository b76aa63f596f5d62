"""The sweep that charts are made of, with what several of them need: scores, settings in order, and names."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast, get_args

from analysis.charts.model import Ending
from analysis.importance import WhatMattered
from analysis.objectives import SettingScores, rank_settings, score_of
from analysis.points import value_text
from analysis.records import Cost, IterationRecord, Objective, SweepRecord, TrialRecord, longest_length
from analysis.tables import point_names
from analysis.wording import short_text

_SCORES: dict[Objective, str] = {
    "final": "final score, mean return in the later half of training",
    "area": "area score, mean return over all of training",
    "best": "best evaluation return",
    "steps_to_threshold": "minus env steps to the threshold",
}
_ENDINGS: dict[str, Ending] = {"completed": "whole", "stopped": "cut", "failed": "failed"}


@dataclass(frozen=True)
class Subject:
    """A sweep."""

    sweep: SweepRecord
    trials: Sequence[TrialRecord]
    results: Mapping[str, Sequence[IterationRecord]]
    """Iterations by trial id, oldest first; a trial may have none."""
    goal: float | None
    """The return that counts as solved; None: there is none."""
    mattered: WhatMattered

    @property
    def varied_names(self) -> list[str]:
        """The searched hyperparameters that have several values, the most important first."""
        # Of layers that are judged one by one the first counts.
        judged = (name if name in self.space else name.partition(".")[0] for name in self.mattered.names)
        names = dict.fromkeys([*judged, *point_names(self.begun)])
        return [name for name in names if len({value_text(trial.point, name) for trial in self.begun}) > 1]

    @property
    def order_of_names(self) -> str:
        """What the names are ordered by."""
        return "the sweep file (too few trials to say what mattered)" if self.mattered.too_few else "importance"

    @cached_property
    def begun(self) -> list[TrialRecord]:
        """The trials that have begun: those that have not may not even have values."""
        return [trial for trial in self.trials if trial.status != "pending"]

    @property
    def space(self) -> Mapping[str, Any]:
        """The space of the sweep file, which records may lack."""
        return self.sweep.section("space")

    @property
    def is_population(self) -> bool:
        """Whether trials change their values while they train."""
        return self.sweep.is_population or any(trial.changes for trial in self.trials)

    @property
    def objective(self) -> Objective:
        """What settings are judged by; what needs a threshold that nobody knows is judged by its end."""
        kind = self.sweep.section("objective").get("type", "final")
        if kind not in get_args(Objective) or (kind == "steps_to_threshold" and self._threshold is None):
            return "final"
        return cast("Objective", kind)

    @property
    def cost(self) -> Cost | None:
        """What settings cost, if the sweep file asks for it."""
        cost = self.sweep.section("objective").get("cost")
        return cast("Cost", cost) if cost in get_args(Cost) else None

    @property
    def _threshold(self) -> float | None:
        own = self.sweep.section("objective").get("threshold")
        return float(own) if isinstance(own, int | float) else self.goal

    @property
    def _num_env_steps(self) -> int:
        stated = self.sweep.section("stop").get("num_env_steps")
        return stated if isinstance(stated, int) else max((trial.num_env_steps for trial in self.trials), default=0)

    @property
    def _num_iterations(self) -> int | None:
        # Trials may tell of changes that the sweep file does not.
        return None if self.is_population else self.sweep.max_iterations

    @cached_property
    def _longest(self) -> int:
        return longest_length(self.trials, num_env_steps=self._num_env_steps, num_iterations=self._num_iterations)

    @property
    def score_name(self) -> str:
        """What scores are, as the name of an axis."""
        return _SCORES[self.objective]

    @cached_property
    def scores(self) -> Mapping[str, float | None]:
        """What each trial scored by the objective; None: it failed, or showed nothing."""
        return {trial.trial_id: self._score(trial) for trial in self.trials}

    def _score(self, trial: TrialRecord) -> float | None:
        if trial.status == "failed":
            return None
        items = self.results.get(trial.trial_id, ())
        score = score_of(
            trial, items, self.objective, num_env_steps=self._num_env_steps, num_iterations=self._num_iterations,
            threshold=self._threshold, longest=self._longest,
        )  # fmt: skip
        return score if score is not None and math.isfinite(score) else None

    @cached_property
    def settings(self) -> list[SettingScores]:
        """The settings, best first; in a population each trial by itself."""
        trials = list(self.trials)
        if self.is_population:
            trials = [trial.model_copy(update={"point_index": trial.index, "seed_index": 0}) for trial in trials]
        return rank_settings(
            trials, self.results, self.objective, num_env_steps=self._num_env_steps,
            num_iterations=self._num_iterations, threshold=self._threshold, longest=self._longest,
        )  # fmt: skip

    def ending(self, trial: TrialRecord) -> Ending:
        """Return how a trial ended."""
        if self.scores[trial.trial_id] is None:
            return "failed"
        return _ENDINGS.get(trial.status, "unfinished")

    @cached_property
    def num_not_whole(self) -> int:
        """How many trials have a score, but were cut early or still run."""
        return sum(self.ending(trial) in ("cut", "unfinished") for trial in self.trials)

    def setting_name(self, setting: SettingScores) -> str:
        """Return a setting in words, the most important value first; a trial of a population by its id."""
        known = [name for name in self.varied_names if name in setting.point]
        if self.is_population or not known:
            return setting.trial_ids[0]
        return ", ".join(f"{name} {short_text(setting.point[name])}" for name in known)

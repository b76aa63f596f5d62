"""The tables of a sweep as pandas DataFrames: trials, iterations, evaluations, settings.

Returns are undiscounted and in reward units, env steps are those of the trial so far, times are seconds. What is not
known is missing (NaN, `<NA>`, an empty cell), never 0. `trial_id` and `point_index` join the tables.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, get_args

from analysis.front import points_on_front
from analysis.objectives import SettingScores, rank_settings, score_of
from analysis.records import IterationRecord, Objective, TrialRecord, longest_length
from analysis.statistics import (
    Estimate,
    iqm,
    known_intervals,
    probability_of_being_best,
    tell_the_best,
    tie_groups,
)
from analysis.tables import cell_value, env_steps_to, iterations_frame, point_names, trials_frame, types_with_gaps
from policies import random_streams

if TYPE_CHECKING:
    import pandas as pd

Rows = Literal["trials", "iterations", "evaluations", "settings"]
"""What a row of a table is."""
ROWS: tuple[Rows, ...] = get_args(Rows)


@dataclass(frozen=True)
class SweepData:
    """What the tables of one sweep are made of."""

    trials: Sequence[TrialRecord]
    results: Mapping[str, Sequence[IterationRecord]]
    """Iterations by trial id, oldest first."""
    objective: Objective
    """What settings are judged by."""
    num_env_steps: int
    """The env steps that a trial has at most, `stop.num_env_steps`."""
    threshold: float | None
    """The return that solves the env; None: nothing is said of solving."""
    failed_score: float | None = None
    """What a training that failed counts as, where other sweeps are looked at too; None: see `objectives`."""
    has_settings: bool = True
    """False of a population, whose trials change their values while they train."""
    num_iterations: int | None = None
    """The iterations that a trial has at most, `stop.num_iterations`; None: any number."""
    longest_env_steps: int | None = None
    """The env steps of the longest training, where other sweeps are looked at too; None: of the longest of `trials`."""

    @cached_property
    def longest(self) -> int:
        """The env steps of the longest training, see `objectives.score_of`."""
        if self.longest_env_steps is not None:
            return self.longest_env_steps
        return longest_length(self.trials, num_env_steps=self.num_env_steps, num_iterations=self.num_iterations)


def make_frame(data: SweepData, rows: Rows) -> pd.DataFrame:
    """Return one of the four tables of a sweep; docs/guides/exports.md says what their columns are."""
    if rows == "trials":
        return all_trials_frame(data)
    if rows == "iterations":
        return iterations_frame(data.results)
    return evaluations_frame(data) if rows == "evaluations" else settings_frame(data)


def all_trials_frame(data: SweepData) -> pd.DataFrame:
    """Return `trials_frame` with the objective's value of each trial, `objective_score`; failed trials have none."""
    frame = trials_frame(data.trials, data.results, threshold=data.threshold)
    by_id = {trial.trial_id: trial for trial in data.trials}
    scores = [_objective_score(by_id[trial_id], data) for trial_id in frame["trial_id"]]
    frame.insert(list(frame.columns).index("score"), "objective_score", scores)
    return frame.astype({"objective_score": "float64"})


def _objective_score(trial: TrialRecord, data: SweepData) -> float | None:
    judged = trial.status in ("completed", "stopped") and data.has_settings
    if not judged or (data.objective == "steps_to_threshold" and data.threshold is None):
        return None
    return score_of(
        trial,
        data.results.get(trial.trial_id, ()),
        data.objective,
        num_env_steps=data.num_env_steps,
        num_iterations=data.num_iterations,
        threshold=data.threshold,
        longest=data.longest,
    )


def evaluations_frame(data: SweepData) -> pd.DataFrame:
    """Return a table with one row per greedy evaluation.

    Columns: trial_id, point_index, seed_index, iteration, num_env_steps, num_episodes, time_s, evaluation_return (the
    mean over the sweep's evaluation seeds), training_return (of the same iteration), has_checkpoint (whether a
    checkpoint of it is still kept).
    """
    import pandas as pd

    shared = ["iteration", "num_env_steps", "num_episodes", "time_s", "evaluation_return", "training_return"]
    rows = []
    for trial in sorted(data.trials, key=lambda item: item.index):
        kept = {checkpoint.iteration for checkpoint in trial.checkpoints}
        rows += [
            {
                "trial_id": trial.trial_id,
                "point_index": trial.point_index,
                "seed_index": trial.seed_index,
                **{name: getattr(item, name) for name in shared},
                "has_checkpoint": item.iteration in kept,
            }
            for item in data.results.get(trial.trial_id, ())
            if item.evaluation_return is not None
        ]
    columns = ["trial_id", "point_index", "seed_index", *shared, "has_checkpoint"]
    frame = pd.DataFrame(rows, columns=columns)
    counts = ["point_index", "seed_index", "iteration", "num_env_steps", "num_episodes"]
    floats = ["time_s", "evaluation_return", "training_return"]
    return frame.astype(dict.fromkeys(counts, "int64") | dict.fromkeys(floats, "float64") | {"has_checkpoint": "bool"})


def settings_frame(data: SweepData) -> pd.DataFrame:
    """Return a table with one row per setting, the one to train with first.

    Columns: rank, point_index, one for each searched hyperparameter, num_seeds, num_failed, num_solved, mean, expected
    (by which they are ranked, see `objectives.expected_means`), iqm, lower, upper (the 95 % interval of the mean over
    training seeds, see `statistics.seed_intervals`), probability_best, may_be_best, num_env_steps (the mean of what a
    training takes, see `objectives.env_steps_of`), on_front (of mean score against that, see `analysis.front`),
    trial_ids. What needs two seeds of some setting that differ is missing where there are none. A population has no
    settings, and no rows.
    """
    import pandas as pd

    ranking = ranked_settings(data)
    intervals = intervals_of(ranking)
    chances, leaders = _certainty(ranking)
    on_front = points_on_front(ranking)
    names = point_names(data.trials)
    rows = [
        {
            "rank": rank,
            "point_index": item.point_index,
            **{name: cell_value(item.point.get(name)) for name in names},
            "num_seeds": len(item.scores),
            "num_failed": item.num_failed,
            "num_solved": num_solved(item, data),
            "mean": item.mean,
            "expected": item.expected,
            "iqm": iqm(item.scores),
            "lower": interval and interval.lower,
            "upper": interval and interval.upper,
            "probability_best": chances.get(item.point_index),
            "may_be_best": None if leaders is None else item.point_index in leaders,
            "num_env_steps": item.cost,
            "on_front": item.point_index in on_front,
            "trial_ids": " ".join(item.trial_ids),
        }
        for rank, (item, interval) in enumerate(zip(ranking, intervals, strict=True), start=1)
    ]
    columns = ["rank", "point_index", *names, *_AFTER_POINT]
    frame = pd.DataFrame(rows, columns=columns)
    floats = ["mean", "expected", "iqm", "lower", "upper", "probability_best", "num_env_steps"]
    counts = dict.fromkeys(["rank", "point_index", "num_seeds", "num_failed"], "int64")
    types = (
        counts
        | dict.fromkeys(floats, "float64")
        | {"num_solved": "Int64", "may_be_best": "boolean", "on_front": "bool"}
    )
    return frame.astype(types | types_with_gaps(rows, names))


_AFTER_POINT = [
    "num_seeds", "num_failed", "num_solved", "mean", "expected", "iqm", "lower", "upper", "probability_best",
    "may_be_best", "num_env_steps", "on_front", "trial_ids",
]  # fmt: skip


def ranked_settings(data: SweepData) -> list[SettingScores]:
    """Return the settings of a sweep, best first; none of a population, or where nothing can be judged."""
    if not data.has_settings or (data.objective == "steps_to_threshold" and data.threshold is None):
        return []
    return rank_settings(
        data.trials, data.results, data.objective, num_env_steps=data.num_env_steps,
        num_iterations=data.num_iterations, threshold=data.threshold, worst=data.failed_score,
        longest=data.longest,
    )  # fmt: skip


def intervals_of(ranking: Sequence[SettingScores]) -> list[Estimate | None]:
    """Return the mean over seeds of each setting with its 95 % interval; None: nothing says how much seeds differ."""
    return known_intervals([item.scores for item in ranking])


def _certainty(ranking: Sequence[SettingScores]) -> tuple[dict[int, float], set[int] | None]:
    """Return the probability of being the best by point index, and the points that may be the best, if known."""
    scores = [item.scores for item in ranking]
    if max(map(len, scores), default=0) < 2:
        return {}, None
    rng = random_streams.fixed()
    try:
        if not tell_the_best(scores):
            return {}, None
        chances = probability_of_being_best(scores, rng=rng)
        leaders = tie_groups(scores, rng=rng).with_leader
    except ValueError:
        return {}, None
    by_point = {item.point_index: float(chance) for item, chance in zip(ranking, chances, strict=True)}
    return by_point, {ranking[index].point_index for index in leaders}


def num_solved(item: SettingScores, data: SweepData) -> int | None:
    """Return how many seeds of a setting reached the threshold in training; None: there is none."""
    if data.threshold is None or not math.isfinite(data.threshold):
        return None
    reached = (env_steps_to(data.threshold, data.results.get(trial_id, ())) for trial_id in item.trial_ids)
    return sum(steps is not None for steps in reached)


def flat(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table whose columns hold one type each, as Parquet needs: columns of mixed values become text."""
    made = frame.copy()
    for name in made.columns:
        kinds = {type(value) for value in made[name].dropna()} if made[name].dtype == object else set()
        if len(kinds) > 1:
            made[name] = made[name].map(_text, na_action="ignore")
    return made


def _text(value: Any) -> str:
    return str(value)

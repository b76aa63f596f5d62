"""What is compared: a sweep by its leading setting, or one setting; with its scores over seeds and its cost."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from analysis.core_seconds import core_seconds
from analysis.exports.frames import SweepData, num_solved, ranked_settings
from analysis.objectives import SettingScores
from analysis.records import FINISHED, Objective, SweepRecord, TrialRecord
from analysis.report_data import env_of
from analysis.selection import error_summary
from analysis.statistics import iqm, known_intervals, moderated_means, steps_to_threshold
from analysis.tables import env_steps_to
from analysis.wording import counted


@dataclass(frozen=True)
class Wanted:
    """A sweep that is to be compared, or one of its settings."""

    name: str
    """As it is shown: `ppo`, or `ppo/t0003`."""
    sweep: SweepRecord
    data: SweepData
    cores: float
    """Cores of a process that trains."""
    point_index: int | None = None
    """The setting; None: the sweep, by its leading one."""

    @property
    def sweep_name(self) -> str:
        """What the sweep is found by: the record of one whose folder was renamed still has its former name."""
        return self.name.partition("/")[0]

    @property
    def origin(self) -> tuple[str, float]:
        """What tells the sweep from all others, also those of its name; a copy of it has the same."""
        return self.sweep.name, self.sweep.created_at


@dataclass(frozen=True)
class Entry:
    """One of the things compared; numbers that are not known are None."""

    letter: str
    """A, B, ..."""
    name: str
    sweep: str
    is_sweep: bool
    """Whether it is a whole sweep, which is compared by its leading setting."""
    algorithm: str
    env_id: str
    objective: Objective
    point_index: int | None
    point: dict[str, Any]
    trial_ids: tuple[str, ...]
    scores: tuple[float, ...]
    """One a training seed, higher is better; a failed seed has the worst score of all sweeps that are compared."""
    num_failed: int
    num_solved: int | None
    mean: float | None
    lower: float | None
    """The 95 % interval of the mean over training seeds; None: no setting of the sweep has two seeds that differ."""
    upper: float | None
    iqm: float | None
    standard_error: float | None
    """Of the mean, moderated over the settings of the sweep."""
    df: float | None
    """Degrees of freedom of that."""
    threshold: float | None
    median_env_steps: float | None
    """Env steps by which half of the seeds had reached the threshold in training; None: they did not."""
    median_lower: float | None
    median_upper: float | None
    num_settings: int
    """Settings of the sweep that have been judged."""
    num_trials: int
    """Trials whose cost is told: of the sweep, or of the setting."""
    num_env_steps: int
    core_seconds: float | None
    wall_s: float | None
    """Seconds that the sweep ran, in runs that have ended; None of a setting, or where none has."""
    why_none: str = ""
    """Why there are no scores; empty if there are."""
    sweep_df: float | None = None
    """Degrees of freedom that the seeds of all settings of the sweep have together; None: as `df`."""
    is_running: bool = False
    """Whether the sweep runs, so that `wall_s` is of what was before this run."""


def judged_alike(
    wanted: Wanted,
    objective: Objective,
    threshold: float | None,
    failed_score: float | None = None,
    *,
    longest: int | None = None,
) -> Wanted:
    """Return what is compared, judged by this objective and solved at this return.

    Args:
        wanted: What is compared.
        objective: What it is judged by.
        threshold: The return that solves the env.
        failed_score: What a failed seed counts as; None: what its sweep by itself says.
        longest: The env steps of the longest training of all that are compared; None: that of its sweep.
    """
    data = replace(
        wanted.data,
        objective=objective,
        threshold=threshold,
        failed_score=failed_score,
        longest_env_steps=longest,
    )
    return replace(wanted, data=data)


def make_entry(wanted: Wanted, letter: str, alone: SweepData, *, shares_threshold: bool = True) -> Entry:
    """Return the scores and the cost of a sweep or a setting.

    Args:
        wanted: What it is of; its `data` says what it is judged by, and which return solves the env.
        letter: What it is called.
        alone: Its `data` as its sweep would have it by itself, whatever failures count as in others, and how long
            those are: that says which setting leads.
        shares_threshold: False: its `data` has no threshold because those that it is compared with have another one.
    """
    data, threshold = wanted.data, wanted.data.threshold
    ranking = ranked_settings(data)
    chosen = _chosen(wanted, ranking, alone)
    mine = _trials_of(wanted)
    costs = core_seconds(data.trials, wanted.cores)
    known = [costs[trial.trial_id] for trial in mine if trial.trial_id in costs]
    entry = Entry(
        letter=letter,
        name=wanted.name,
        sweep=wanted.sweep_name,
        is_sweep=wanted.point_index is None,
        algorithm=str(wanted.sweep.spec.get("algorithm", "?")),
        env_id=env_of(wanted.sweep),
        objective=data.objective,
        point_index=wanted.point_index if chosen is None else chosen.point_index,
        point=(mine[0].point if mine and wanted.point_index is not None else {}) if chosen is None else chosen.point,
        trial_ids=() if chosen is None else chosen.trial_ids,
        scores=() if chosen is None else chosen.scores,
        num_failed=sum(trial.status == "failed" for trial in mine) if chosen is None else chosen.num_failed,
        num_solved=None if chosen is None else num_solved(chosen, data),
        mean=None,
        lower=None,
        upper=None,
        iqm=None,
        standard_error=None,
        df=None,
        threshold=threshold,
        median_env_steps=None,
        median_lower=None,
        median_upper=None,
        num_settings=len(ranking),
        num_trials=len(mine),
        num_env_steps=sum(trial.num_env_steps for trial in mine),
        core_seconds=math.fsum(known) if known else None,
        # It is written when a run ends.
        wall_s=(wanted.sweep.run_time_s or None) if wanted.point_index is None else None,
        is_running=wanted.sweep.state == "running",
        why_none="" if chosen is not None else why_no_scores(wanted, shares_threshold=shares_threshold),
    )
    if chosen is None:
        return entry
    return replace(entry, **_scored(chosen, ranking), **_median(chosen, data))


def _trials_of(wanted: Wanted) -> list[TrialRecord]:
    return [trial for trial in wanted.data.trials if wanted.point_index in (None, trial.point_index)]


def _chosen(wanted: Wanted, ranking: Sequence[SettingScores], alone: SweepData) -> SettingScores | None:
    index = wanted.point_index
    if index is None:
        # The setting that the sweep names by itself, whatever the others' worst is, and how long they are.
        is_judged_anew = alone.longest != wanted.data.longest or any(item.num_unscored for item in ranking)
        own = ranked_settings(alone) if is_judged_anew else ranking
        index = own[0].point_index if own else None
    return next((item for item in ranking if item.point_index == index), None)


def why_no_scores(wanted: Wanted, *, shares_threshold: bool = True) -> str:
    """Return why a sweep or a setting has no scores; its arguments are as those of `make_entry`."""
    mine = _trials_of(wanted)
    if not wanted.data.has_settings:
        return "it is a population, whose trials change their values while they train: none has a setting"
    if wanted.data.objective == "steps_to_threshold" and wanted.data.threshold is None:
        why = "neither its sweep file nor its environment has one" if shares_threshold else "they share none"
        return f"it is judged by the env steps to a threshold, and {why}"
    if not mine:
        return "it has no trials yet"
    failed = [trial for trial in mine if trial.status == "failed"]
    if len(failed) == len(mine):
        return f"all of its {counted(len(mine), 'trial')} failed, the first: {error_summary(failed[0].error)}"
    ended = [trial for trial in mine if trial.status in FINISHED and trial.status != "failed"]
    if not ended:
        return f"none of its {counted(len(mine), 'trial')} has ended yet"
    return "none of its trials has a whole episode or an evaluation with a finite return"


def _scored(chosen: SettingScores, ranking: Sequence[SettingScores]) -> dict[str, Any]:
    """Return the mean over seeds, and its interval and error as far as they are known."""
    scores = [item.scores for item in ranking]
    index = list(ranking).index(chosen)
    found = {"mean": chosen.mean, "iqm": iqm(chosen.scores)}
    if max(map(len, scores)) < 2:
        return found
    try:
        interval, fit = known_intervals(scores)[index], moderated_means(scores)
    except ValueError:  # so large that their squares are not finite
        return found
    return {
        **found,
        "lower": interval and interval.lower,
        "upper": interval and interval.upper,
        "standard_error": float(fit.standard_errors[index]),
        "df": float(fit.dfs[index]),
        "sweep_df": float(fit.num_seeds.sum() - fit.num_seeds.size),
    }


def _median(chosen: SettingScores, data: SweepData) -> dict[str, Any]:
    """Return the median of the env steps to the threshold; seeds that did not reach it are censored.

    One that failed, or that a scheduler ended, counts with the env steps that it was to have: taken out where it ended,
    it would leave the median to those that went well.
    """
    if data.threshold is None:
        return {}
    rows = [data.results.get(trial_id, ()) for trial_id in chosen.trial_ids]
    reached = [env_steps_to(data.threshold, items) for items in rows]
    ends = [items[-1].num_env_steps if items else 0 for items in rows]
    completed = {trial.trial_id for trial in data.trials if trial.status == "completed"}
    # A last iteration may go beyond what was to be trained.
    whole = max(*chosen.env_steps, *ends)
    lengths = [end if trial_id in completed else whole for trial_id, end in zip(chosen.trial_ids, ends, strict=True)]
    curve = steps_to_threshold(reached, lengths)
    lower, upper = curve.median_interval
    several = len(rows) > 1
    return {
        "median_env_steps": curve.median,
        "median_lower": lower if several else None,
        "median_upper": upper if several else None,
    }

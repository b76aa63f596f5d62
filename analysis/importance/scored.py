"""The score of each point of a sweep, all judged after the same training.

The seeds of a point are one cluster: a point counts once, with its mean. A trial that failed, or never showed anything
that can be scored, has the worst score of all (`objectives.failed_score`). Where a scheduler ended trials early, all
are judged at the env steps of the first one that it ended (`analysis.importance.cut_short`).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from analysis.importance.cut_short import is_evaluated, notes_of_cut, rows_until, training_alone
from analysis.objectives import failed_score, score_of
from analysis.records import (
    FINISHED,
    IterationRecord,
    Objective,
    SweepRecord,
    TrialRecord,
    finite_or_none,
    longest_length,
)
from analysis.wording import counted


@dataclass(frozen=True)
class Scored:
    """The points of a sweep that have a score."""

    objective: Objective
    """What scores are of: the sweep's, or `final` where trials can be judged by training episodes alone."""
    points: tuple[dict[str, Any], ...]
    scores: tuple[float, ...]
    """Mean over the seeds of each point, higher is better."""
    num_trials: int
    why_none: str = ""
    """Why there are no scores; empty if there are."""
    notes: tuple[str, ...] = ()
    num_env_steps: int | None = None
    """The env steps at which all trials are judged; None: at their ends."""


def score_points(
    sweep: SweepRecord,
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    threshold: float | None,
) -> Scored:
    """Return the points of a sweep with their scores; the arguments are those of `what_mattered`."""
    wish = sweep.section("objective")
    objective: Objective = wish.get("type", "final")
    given = finite_or_none(wish.get("threshold"))
    goal = threshold if given is None else given
    ended = [trial for trial in sorted(trials, key=lambda item: item.index) if trial.status in FINISHED]
    why_none = _why_none(sweep, trials, ended, objective, goal)
    if why_none:
        return Scored(objective, (), (), 0, why_none)
    first_cut = min((trial.num_env_steps for trial in ended if trial.status == "stopped"), default=None)
    most = int(sweep.section("stop").get("num_env_steps") or max(trial.num_env_steps for trial in ended))
    whole = longest_length(ended, num_env_steps=most, num_iterations=sweep.max_iterations)
    shown = [trial for trial in ended if trial.status != "failed"]
    ever, num_unevaluated = (set[str](), 0) if first_cut is None else _evaluated(shown, results, first_cut)
    if num_unevaluated:
        objective = "final"
    found = {
        trial.trial_id: finite_or_none(
            score_of(
                trial, _judged(results.get(trial.trial_id, ()), first_cut, alone=num_unevaluated > 0), objective,
                num_env_steps=first_cut or whole, num_iterations=sweep.max_iterations, threshold=goal,
            )
        )
        for trial in shown
    }  # fmt: skip
    # They showed something, but later.
    left_out = {trial_id for trial_id in ever if found[trial_id] is None}
    known = [score for score in found.values() if score is not None]
    if not known:
        by_then = "" if first_cut is None else f" by {first_cut:,} env steps, where the scheduler ended the first"
        return Scored(objective, (), (), 0, f"No trial showed a score{by_then}.")
    worst = failed_score(known, objective, num_env_steps=first_cut or whole)
    seeds: defaultdict[int, list[float]] = defaultdict(list)
    values: dict[int, dict[str, Any]] = {}
    for trial in ended:
        if trial.trial_id not in left_out:
            score = found.get(trial.trial_id)
            seeds[trial.point_index].append(worst if score is None else score)
            values[trial.point_index] = trial.point
    notes = list(_notes_of_worst(num_failed=len(ended) - len(shown), num_lost=len(found) - len(known) - len(left_out)))
    if first_cut is not None:
        notes += notes_of_cut(ended, first_cut, num_unevaluated=num_unevaluated, num_left_out=len(left_out))
    if len(ended) < len(trials):
        notes.append(f"Left out, as they have not ended: {counted(len(trials) - len(ended), 'trial')}.")
    return Scored(
        objective,
        tuple(values.values()),
        # Divided first, as the sum of scores that are nearly too large for a float is too large.
        tuple(math.fsum(score / len(scores) for score in scores) for scores in seeds.values()),
        len(ended) - len(left_out),
        notes=tuple(notes),
        num_env_steps=first_cut,
    )


def _evaluated(
    shown: Sequence[TrialRecord], results: Mapping[str, Sequence[IterationRecord]], first_cut: int
) -> tuple[set[str], int]:
    """Return the trials that were ever evaluated, and how many of them were not by the first cut."""
    ever: set[str] = set()
    num_unevaluated = 0
    for trial in shown:
        rows = results.get(trial.trial_id, ())
        if is_evaluated(rows):
            ever.add(trial.trial_id)
            num_unevaluated += not is_evaluated(rows_until(rows, first_cut))
    return ever, num_unevaluated


def _judged(rows: Sequence[IterationRecord], first_cut: int | None, *, alone: bool) -> Sequence[IterationRecord]:
    """Return the iterations that a trial is judged by: up to the first cut, if any, maybe with training `alone`."""
    if first_cut is None:
        return rows
    until = rows_until(rows, first_cut)
    return training_alone(until, first_cut // 2) if alone else until


def _notes_of_worst(*, num_failed: int, num_lost: int) -> Iterator[str]:
    if num_failed:
        yield f"{counted(num_failed, 'trial')} counted as the worst, having failed."
    if num_lost:
        yield f"{counted(num_lost, 'trial')} counted as the worst, without a finite return to be judged by."


def _why_none(
    sweep: SweepRecord,
    trials: Sequence[TrialRecord],
    ended: Sequence[TrialRecord],
    objective: Objective,
    goal: float | None,
) -> str:
    if sweep.is_population or any(trial.changes for trial in trials):
        return "Population based training changes values while a trial trains, so no value has a score of its own."
    if objective == "steps_to_threshold" and goal is None:
        return "The objective is steps_to_threshold, and the threshold is not known: set objective.threshold."
    if not ended:
        return "No trial has ended yet."
    if all(trial.status == "failed" for trial in ended):
        return "All trials failed."
    return ""

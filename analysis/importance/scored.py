"""The score of each point of a sweep, all judged after the same training.

The seeds of a point are one cluster: a point counts once, with its mean. A trial that failed, or showed nothing that
can be scored, has the worst score of all. Where a scheduler ended trials early, all are judged at the env steps of the
first one that it ended: the trials that it let go on are a choice of the better ones, in which what makes trials bad
would not be seen.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from analysis.objectives import score_of
from analysis.records import FINISHED, IterationRecord, Objective, SweepRecord, TrialRecord, finite_or_none
from analysis.wording import counted


@dataclass(frozen=True)
class Scored:
    """The points of a sweep that have a score."""

    objective: Objective
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
    whole = int(sweep.section("stop").get("num_env_steps") or max(trial.num_env_steps for trial in ended))

    def shown(trial: TrialRecord) -> float | None:
        """Return what a trial scored at the env steps that all are judged at; None: it failed, or showed nothing."""
        if trial.status == "failed":
            return None
        rows = results.get(trial.trial_id, ())
        if first_cut is not None:
            rows = [row for row in rows if row.num_env_steps <= first_cut]
        return finite_or_none(score_of(trial, rows, objective, num_env_steps=first_cut or whole, threshold=goal))

    found = [shown(trial) for trial in ended]
    known = [score for score in found if score is not None]
    if not known:
        return Scored(objective, (), (), 0, "No trial showed a score.")
    worst = min(known)
    seeds: defaultdict[int, list[float]] = defaultdict(list)
    values: dict[int, dict[str, Any]] = {}
    for trial, score in zip(ended, found, strict=True):
        seeds[trial.point_index].append(worst if score is None else score)
        values[trial.point_index] = trial.point
    return Scored(
        objective,
        tuple(values.values()),
        # Divided first, as the sum of scores that are nearly too large for a float is too large.
        tuple(math.fsum(score / len(scores) for score in scores) for scores in seeds.values()),
        len(ended),
        notes=tuple(_notes(ended, first_cut, num_lost=len(ended) - len(known), num_waiting=len(trials) - len(ended))),
        num_env_steps=first_cut,
    )


def _notes(ended: Sequence[TrialRecord], first_cut: int | None, *, num_lost: int, num_waiting: int) -> Iterator[str]:
    """Say what the scores are not; `first_cut` is the env step at which a scheduler ended the first trial, if any."""
    if num_lost:
        yield f"{counted(num_lost, 'trial')} without a score counted as the worst, having failed or ended no episode."
    if first_cut is not None:
        num_cut = sum(trial.status == "stopped" for trial in ended)
        yield (
            f"The scheduler ended {num_cut:,} of {counted(len(ended), 'trial')} early. All are judged at {first_cut:,} "
            "env steps, which each of them has done, so this is about the beginning of training."
        )
    if num_waiting:
        yield f"Left out, as they have not ended: {counted(num_waiting, 'trial')}."


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

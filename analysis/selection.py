"""The one place that decides which checkpoints of a sweep are ahead by their evaluations.

The policy to deploy is chosen among the leading ones of all trials (`policy_candidates`) by more episodes, which
`analysis.successive_rejects` describes. What follows is who leads while a sweep runs, and the order of points.

Words: a *usable* trial did not fail and keeps at least one checkpoint with a finite evaluation return; its
*score* is the highest of them. The score of a *point* is the mean score of its usable trials, one per seed. A
point is *complete* when every one of its seeds is usable.

The rule, in order:

1. Complete points come before incomplete ones, because a failed seed must not raise its point's mean by its absence.
2. The higher point score wins; then fewer env steps (mean over the seeds); then the lower trial index.
3. Within the winning point: the trial with the highest score; then fewer env steps; then the lower index.
4. Within the winning trial: the checkpoint with the highest evaluation return; then fewer env steps.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from analysis.best_records import BestRecord
from analysis.records import FINISHED, CheckpointRecord, TrialRecord, finite_or_none
from policies.errors import NotFoundError

_MAX_ERROR_CHARS = 300


class NoUsableTrialError(NotFoundError):
    """No trial of the sweep has a checkpoint that may win; the message says why."""


@dataclass(frozen=True)
class TrialScore:
    """A usable trial and the checkpoint it would win with."""

    trial: TrialRecord
    checkpoint: CheckpointRecord
    score: float
    """Mean evaluation return of the checkpoint, reward units."""


@dataclass(frozen=True)
class PointScore:
    """A point with at least one usable trial."""

    point_index: int
    point: dict[str, Any]
    score: float
    """Mean score over the usable seeds, reward units."""
    num_env_steps: float
    """Env steps to those scores, mean over the usable seeds."""
    num_seeds: int
    """The number of seeds the point should have; `len(trial_scores)` of them are usable."""
    trial_scores: tuple[TrialScore, ...]
    """The usable trials, best first."""

    @property
    def complete(self) -> bool:
        """Whether every seed of the point is usable."""
        return len(self.trial_scores) == self.num_seeds


@dataclass(frozen=True)
class Selection:
    """Who leads in a sweep, by evaluations alone."""

    checkpoint: CheckpointRecord
    trial: TrialRecord
    score: float
    """Evaluation return of the winning checkpoint, which its confirmation is compared with."""
    ranking: tuple[PointScore, ...]
    """Every point with a usable trial, best first; the winner is in the first."""

    @property
    def point_score(self) -> float:
        """The winning point's score, the mean over its seeds, by which it was chosen."""
        return self.ranking[0].score


def score_trial(trial: TrialRecord) -> TrialScore | None:
    """Return the checkpoint that a trial would win with, or None if the trial is not usable."""
    if trial.status == "failed":
        return None
    best = _best_of(trial.checkpoints)
    return None if best is None else TrialScore(trial, best[1], best[0])


def best_checkpoint(checkpoints: Iterable[CheckpointRecord]) -> CheckpointRecord | None:
    """Return the best of some checkpoints of one trial, by number 4 of the rule; None if none was evaluated.

    A trial always keeps this checkpoint, whichever others it deletes.
    """
    best = _best_of(checkpoints)
    return None if best is None else best[1]


def policy_candidates(trials: Sequence[TrialRecord]) -> list[TrialScore]:
    """Return every checkpoint that may be deployed, of all trials and points, the highest evaluation return first.

    A trial that failed has none: what was wrong with it may be wrong with its checkpoints. A point that has a failed
    seed has, because that says something of training with it, but nothing of a policy that was trained.

    Where evaluations are equal, the higher training return is first, as it was measured over other and more episodes.
    """
    scored = [
        TrialScore(trial, checkpoint, score)
        for trial in trials
        if trial.status != "failed"
        for checkpoint in trial.checkpoints
        if (score := finite_or_none(checkpoint.evaluation_return)) is not None
    ]
    return sorted(scored, key=_candidate_order)


def is_current(best: BestRecord, trials: Sequence[TrialRecord]) -> bool:
    """Whether a policy was chosen from those checkpoints that it would be chosen from now.

    They are others where the sweep was extended or trained on since.
    """
    if best.choice is None:  # of an older version, whose rule was `select_best`
        try:
            return select_best(trials).checkpoint == best.checkpoint
        except NoUsableTrialError:
            return False
    known = [item.checkpoint for item in policy_candidates(trials)]
    chosen = {item.checkpoint.path: item.checkpoint for item in best.choice.candidates}
    # They are the first of all, whether they could be read or not.
    return len(known) == best.choice.num_known and {item.path: item for item in known[: len(chosen)]} == chosen


def _candidate_order(item: TrialScore) -> tuple[float, float, int, int, int]:
    training = finite_or_none(item.checkpoint.training_return)
    return (-item.score, math.inf if training is None else -training, *tie_key(item))


def tie_key(item: TrialScore) -> tuple[int, int, int]:
    """Return what decides between policies that nothing else tells apart; the lowest wins."""
    return item.checkpoint.num_env_steps, item.trial.index, item.checkpoint.iteration


def _best_of(checkpoints: Iterable[CheckpointRecord]) -> tuple[float, CheckpointRecord] | None:
    scores = ((finite_or_none(item.evaluation_return), item) for item in checkpoints)
    scored = [(score, item) for score, item in scores if score is not None]
    return min(scored, key=lambda pair: (-pair[0], pair[1].num_env_steps), default=None)


def rank_points(trials: Sequence[TrialRecord]) -> list[PointScore]:
    """Return every point that has a usable trial, best first by the rule of this module.

    Trials may be in any order and in any status, so that a live view can call this while the sweep runs.
    """
    by_point: defaultdict[int, list[TrialRecord]] = defaultdict(list)
    for trial in trials:
        by_point[trial.point_index].append(trial)
    # A seed without a record counts like one that failed: a point has the number of seeds of the sweep, and more if it
    # was replicated.
    least = _seeds_per_point(trials)
    points = []
    for point_index, members in by_point.items():
        scored = [score for score in map(score_trial, members) if score is not None]
        if not scored:
            continue
        scored.sort(key=_trial_order)
        points.append(
            PointScore(
                point_index=point_index,
                point=scored[0].trial.point_at(scored[0].checkpoint.iteration),
                score=sum(item.score for item in scored) / len(scored),
                num_env_steps=sum(item.checkpoint.num_env_steps for item in scored) / len(scored),
                num_seeds=max(least, *(trial.seed_index + 1 for trial in members)),
                trial_scores=tuple(scored),
            )
        )
    points.sort(key=_point_order)
    return points


def _seeds_per_point(trials: Sequence[TrialRecord]) -> int:
    """Return how many seeds each point has at least, by the indices of the trials (see `analysis.numbering`).

    Trial s of point p has the index p x seeds per point + s, or a higher one, behind replications.
    """
    seeds = [(trial.index - trial.seed_index) // trial.point_index for trial in trials if trial.point_index > 0]
    return max(1, min(seeds, default=1))


def select_best(trials: Sequence[TrialRecord]) -> Selection:
    """Return the checkpoint that leads in the sweep, by its evaluations alone.

    Raises:
        NoUsableTrialError: No trial is usable.
    """
    ranking = rank_points(trials)
    if not ranking:
        raise no_usable_trial(trials)
    winner = ranking[0].trial_scores[0]
    return Selection(winner.checkpoint, winner.trial, winner.score, tuple(ranking))


def _trial_order(item: TrialScore) -> tuple[float, int, int]:
    return (-item.score, item.checkpoint.num_env_steps, item.trial.index)


def _point_order(item: PointScore) -> tuple[bool, float, float, int]:
    lowest_index = min(score.trial.index for score in item.trial_scores)
    return (not item.complete, -item.score, item.num_env_steps, lowest_index)


def no_usable_trial(trials: Sequence[TrialRecord]) -> NoUsableTrialError:
    """Return the error for a sweep without a usable trial."""
    return NoUsableTrialError(*_why_none(trials))


def _why_none(trials: Sequence[TrialRecord]) -> tuple[str, str]:
    """Return message and hint for a sweep without a usable trial."""
    if not trials:
        return "No trial is usable: the sweep has no trials yet.", "Launch it, or wait for its first result."
    failed = [trial for trial in trials if trial.status == "failed"]
    waiting = sum(trial.status == "pending" for trial in trials)
    others = len(trials) - len(failed) - waiting
    counts = [
        (len(failed), "failed"),
        (waiting, "not started"),
        (others, "without a kept checkpoint that has a finite evaluation return"),
    ]
    parts = ", ".join(f"{count} {what}" for count, what in counts if count)
    message = f"No trial of {len(trials)} is usable: {parts}."
    if failed:
        first = min(failed, key=lambda trial: trial.index)
        hint = error_hint(first.error)
        return (
            f"{message} First error ({first.trial_id}): {error_summary(first.error)}",
            f"Read the log of {first.trial_id}, mend the cause and launch again."
            if hint is None
            else f"{hint} The log of {first.trial_id} says more.",
        )
    if any(trial.status not in FINISHED for trial in trials):
        return message, "Wait for the first evaluation, or resume the sweep if it was interrupted."
    return message, "Evaluate more often (evaluation.every_iterations), or let the trials train longer."


def error_summary(error: str | None) -> str:
    """Return the line of a recorded error that names it, shortened: its first, or a traceback's exception."""
    lines = [line.rstrip() for line in (error or "").splitlines() if line.strip()]
    if not lines:
        return "no message was recorded"
    line = lines[0]
    if line.startswith("Traceback"):
        # Frames are indented; the first line that is not indented names the exception.
        line = next((item for item in lines[1:] if not item[0].isspace()), line)
    line = line.strip()
    return line if len(line) <= _MAX_ERROR_CHARS else line[: _MAX_ERROR_CHARS - 1] + "…"


def error_hint(error: str | None) -> str | None:
    """Return the line of a recorded error that says what to do; None: there is none.

    An error that has one is its message and that line, and at the end of the log behind them both stand again.
    """
    message, _, rest = (error or "").partition("\n")
    hint, _, log = rest.partition("\n")
    is_repeated = bool(message.strip() and hint.strip()) and f"{message}\n{hint}" in log
    return hint if is_repeated and not hint[0].isspace() else None

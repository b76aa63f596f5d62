"""Say in words what the policy to deploy was chosen from, and how each candidate fared."""

from __future__ import annotations

import math
from dataclasses import dataclass

from analysis.best_records import BestRecord, CandidateRecord, ChoiceRecord, EvaluationRecord
from analysis.statistics import episodes_interval
from analysis.successive_rejects import TIED
from analysis.wording import NONE, counted, interval_text, range_text, return_text
from policies import random_streams

COLUMNS = ("policy", "episodes", "score", "95 % interval", "confirmed at", "rejected")
_MAX_AVERAGED = 1e150
_MAX_REASON_CHARS = 120


@dataclass(frozen=True)
class CandidateRow:
    """A candidate in words, in the order of `COLUMNS`."""

    policy: str
    num_episodes: str
    score: str
    interval: str
    """The interval over episodes of this policy."""
    confirmation: str
    rejected: str

    @property
    def cells(self) -> tuple[str, ...]:
        """The text of each column."""
        return (self.policy, self.num_episodes, self.score, self.interval, self.confirmation, self.rejected)


def chosen_from(choice: ChoiceRecord) -> str:
    """Return what a policy was chosen from, in how many rounds, and what these cost."""
    known = counted(choice.num_known, "kept checkpoint")
    num_played = len(choice.played)
    left_out = len(choice.candidates) - num_played
    but = f" ({counted(left_out, 'other')} left out)" if left_out else ""
    if choice.num_rounds == 0:
        return f"{known}{but}; with one candidate nothing more was played"
    # Episodes that are longer than those before them may take more.
    most = "of at most" if choice.num_env_steps <= choice.max_env_steps else "in place of"
    spent = (
        f"{counted(choice.num_episodes, 'more episode')} ({choice.num_env_steps:,} {most} "
        f"{counted(choice.max_env_steps, 'env step')})"
    )
    tied = sum(item.reason == TIED for item in choice.candidates)
    equal = f"; {counted(tied, 'other')} scored the same to the last episode" if tied else ""
    return f"{known}: the leading {num_played}{but} in {counted(choice.num_rounds, 'round')}, {spent}{equal}"


def candidate_rows(best: BestRecord, *, none: str = NONE) -> list[CandidateRow]:
    """Return the candidates of a policy in words, the winner first; empty if an older version chose it."""
    if best.choice is None:
        return []
    return [_row(item, best, none) for item in best.choice.candidates]


def _row(item: CandidateRecord, best: BestRecord, none: str) -> CandidateRow:
    won = item.rejected_in is None
    interval = none
    if item.lower is not None and item.upper is not None:
        interval = "all equal" if item.lower == item.upper else range_text(item.lower, item.upper)
    return CandidateRow(
        f"{item.checkpoint.trial_id} at {item.checkpoint.num_env_steps:,}",
        f"{item.num_episodes:,}" if item.num_episodes else none,
        return_text(item.score if math.isfinite(item.score) else None, none=none),
        interval,
        _confirmed(best.confirmation if won else item.confirmation, none),
        "chosen" if won else _out(item),
    )


def _confirmed(record: EvaluationRecord | None, none: str) -> str:
    if record is None:
        return none
    text = return_text(record.mean_return)
    if record.num_episodes == 1:
        return text
    if min(record.returns) == max(record.returns):
        return f"{text} (all {record.num_episodes:,} equal)"
    if any(abs(value) >= _MAX_AVERAGED or math.isnan(value) for value in record.returns):
        return text
    # The same resamples as for the winner's card, so that a page has one interval for one thing.
    return f"{text} ({interval_text(episodes_interval(record.returns, rng=random_streams.fixed()))})"


def _out(item: CandidateRecord) -> str:
    reason = item.reason if len(item.reason) <= _MAX_REASON_CHARS else f"{item.reason[: _MAX_REASON_CHARS - 1]}…"
    if item.rejected_in == 0:
        return f"left out: {reason}"
    return f"round {item.rejected_in}: {reason}" if reason else f"round {item.rejected_in}"

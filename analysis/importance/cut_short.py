"""Trials at an env step before their ends, where a scheduler ended some: all are judged at that of the first it ended.

The trials that it let go on are a choice of the better ones, in which what makes trials bad would not be seen. Trials
are not all evaluated at the same env steps (decision 6): those with a large train batch seldom are. To take for what a
trial had reached by then its next evaluation would make these the best, as it comes later, and to say that they had
reached nothing would make them the worst.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from analysis.records import IterationRecord, TrialRecord, finite_or_none
from analysis.wording import counted


def rows_until(rows: Sequence[IterationRecord], num_env_steps: int) -> list[IterationRecord]:
    """Return a trial's iterations as if it had been cut at a number of env steps.

    Of an iteration that goes on beyond it there are as many of the episodes, in their order, as its share of the env
    steps is. A trial that was evaluated before and after it has an evaluation there, on the straight line between the
    two.

    Args:
        rows: The iterations, oldest first.
        num_env_steps: Where they are cut; a trial that ended before is as it was at its end.
    """
    done = [row for row in rows if row.num_env_steps <= num_env_steps]
    if len(done) == len(rows):
        return done
    part, _ = _parted(rows[len(done)], done[-1].num_env_steps if done else 0, num_env_steps)
    return [*done, part.model_copy(update={"evaluation_return": _between(rows, num_env_steps)})]


def training_alone(rows: Sequence[IterationRecord], parted_at: int) -> list[IterationRecord]:
    """Return iterations without their evaluations, so that one begins just after a number of env steps.

    Args:
        rows: The iterations, oldest first.
        parted_at: Where the half begins that counts: with a large train batch one iteration may be in both.
    """
    found, begin = [], 0
    for row in rows:
        parts = _parted(row, begin, parted_at) if begin < parted_at < row.num_env_steps else (row,)
        found += [part.model_copy(update={"evaluation_return": None}) for part in parts]
        begin = row.num_env_steps
    return found


def _parted(row: IterationRecord, begin: int, num_env_steps: int) -> tuple[IterationRecord, IterationRecord]:
    """Return an iteration up to a number of env steps within it, and the rest; it began at `begin`."""
    num_episodes = int(len(row.episode_returns) * (num_env_steps - begin) / (row.num_env_steps - begin))

    def part(episodes: slice, steps: int) -> IterationRecord:
        kept = {name: getattr(row, name)[episodes] for name in ("episode_returns", "episode_lengths")}
        return row.model_copy(update={"num_env_steps": steps, **kept})

    return part(slice(num_episodes), num_env_steps), part(slice(num_episodes, None), row.num_env_steps)


def is_evaluated(rows: Sequence[IterationRecord]) -> bool:
    """Whether a trial has a finite evaluation."""
    return any(finite_or_none(row.evaluation_return) is not None for row in rows)


def notes_of_cut(
    ended: Sequence[TrialRecord], num_env_steps: int, *, num_unevaluated: int, num_left_out: int
) -> Iterator[str]:
    """Say how trials are judged of which a scheduler ended some.

    Args:
        ended: The trials that have ended.
        num_env_steps: Where they are judged.
        num_unevaluated: How many were evaluated, but not by then.
        num_left_out: How many are left out therefore, as they had ended no episode by then.
    """
    num_cut = sum(trial.status == "stopped" for trial in ended)
    num_before = sum(trial.status != "failed" and trial.num_env_steps < num_env_steps for trial in ended)
    before = f", those that ended before ({counted(num_before, 'trial')}) as they were at last" if num_before else ""
    yield (
        f"The scheduler ended {num_cut:,} of {counted(len(ended), 'trial')} early. All are judged at "
        f"{num_env_steps:,} env steps{before}, so this is about the beginning of training."
    )
    if num_unevaluated:
        yield (
            f"{counted(num_unevaluated, 'trial')} had not been evaluated by then, so the scores of all are mean "
            "returns of training episodes."
        )
    if num_left_out:
        yield f"Left out, as they had ended no episode by then: {counted(num_left_out, 'trial')}."


def _between(rows: Sequence[IterationRecord], num_env_steps: int) -> float | None:
    """Return the evaluation on the line between two; None: there was one just then, or none before or after."""
    known = [(row.num_env_steps, value) for row in rows if (value := finite_or_none(row.evaluation_return)) is not None]
    before = [item for item in known if item[0] <= num_env_steps]
    if not before or len(before) == len(known) or before[-1][0] == num_env_steps:
        return None
    (begin, first), (end, second) = before[-1], known[len(before)]
    share = (num_env_steps - begin) / (end - begin)
    return (1.0 - share) * first + share * second

"""Which stop rule of a sweep ends a trial, in words."""

from __future__ import annotations

from analysis.records import IterationRecord
from tune_jobs.spec.sections import StopSpec


def stop_reason(
    stop: StopSpec, record: IterationRecord, evaluation_return: float | None, *, is_full: bool
) -> str | None:
    """Return the rule that ends a trial after an iteration, with the value that reached it, or None.

    Args:
        stop: The sweep's rules.
        record: The iteration.
        evaluation_return: That of the policy after it; None: it was not evaluated.
        is_full: Whether the training return is the mean of 100 episodes. With fewer, a lucky start would
            count as solved.
    """
    goals = {
        "training_return": (record.training_return if is_full else None, stop.training_return),
        "evaluation_return": (evaluation_return, stop.evaluation_return),
    }
    for goal, (value, target) in goals.items():
        if value is not None and target is not None and value >= target:
            return _told(goal, value, target)
    caps = {
        "num_episodes": (record.num_episodes, stop.num_episodes),
        "num_env_steps": (record.num_env_steps, stop.num_env_steps),
        "num_iterations": (record.iteration, stop.num_iterations),
    }
    for name, (count, cap) in caps.items():
        if cap is not None and count >= cap:
            return f"{name} {count} >= {cap}"
    # A wait for others is no training of its own; a trial that gave its place away does not count it at all.
    if (trained_s := record.time_s - record.waited_s) >= stop.time_s:
        return _told("time_s", trained_s, stop.time_s, decimals=0)
    return None


def _told(name: str, value: float, target: float, *, decimals: int = 4) -> str:
    """Return in words that a value reached its target; it is rounded unless that would bring it below the target."""
    rounded = round(float(value), decimals) + 0.0  # -0.0 is 0
    return f"{name} {_digits(rounded if rounded >= target else value)} >= {_digits(target)}"


def _digits(number: float) -> str:
    """Return a number with all of its digits, so that the comparison that is told is the one that was made."""
    return repr(float(number)).removesuffix(".0")

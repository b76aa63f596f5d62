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
    if is_full and _reaches(record.training_return, stop.training_return):
        return f"training_return {record.training_return:.4g} >= {stop.training_return:g}"
    if _reaches(evaluation_return, stop.evaluation_return):
        return f"evaluation_return {evaluation_return:.4g} >= {stop.evaluation_return:g}"
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
        return f"time_s {trained_s:.0f} >= {stop.time_s:g}"
    return None


def _reaches(value: float | None, target: float | None) -> bool:
    return value is not None and target is not None and value >= target

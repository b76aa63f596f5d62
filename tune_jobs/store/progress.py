"""Where a trial stands: what its process tells the one that drives the sweep."""

from __future__ import annotations

from dataclasses import dataclass

from analysis.records import CheckpointRecord


@dataclass(frozen=True)
class Progress:
    """Where a trial stands; what its process tells the one that drives the sweep."""

    iteration: int
    num_env_steps: int
    num_episodes: int
    time_s: float
    training_return: float | None
    evaluation_return: float | None
    best_evaluation_return: float | None
    best_iteration: int | None
    evaluated: bool
    """Whether `evaluation_return` is of this very iteration."""
    status: str
    """running, paused (asked to stop), completed or failed; a pack says stopped of a member that was to be ended."""
    stop_reason: str | None = None
    error: str | None = None
    notes: tuple[str, ...] = ()
    """What was damaged when the trial was opened, and what it goes on from instead."""
    checkpoints: tuple[CheckpointRecord, ...] = ()
    started_at: float | None = None
    """Unix time at which the first iteration here began, seconds."""
    ended_at: float | None = None
    """Unix time at which the trial ended or paused; None while it runs."""

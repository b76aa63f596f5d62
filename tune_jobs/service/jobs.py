"""What the queue holds: a job is one thing to do with one sweep."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Verb = Literal["drive", "extend", "inject", "replicate", "retry"]
JobState = Literal["creating", "waiting", "running", "ended"]
Outcome = Literal["completed", "failed", "stopped", "cancelled"]

MAX_PRIORITY = 100
NO_BEST = "No best policy: "
"""Begins, in the message of a job that completed, why its sweep has no best policy: to the end of the message."""


class Job(BaseModel):
    """One thing to do with one sweep; times are seconds since 1970."""

    model_config = ConfigDict(frozen=True, from_attributes=True)

    id: int = Field(description="Number of the job, in the order of submission.")
    uid: str = Field(description="Random name of the job, by which its files are known.")
    sweep: str = Field(description="Name of the sweep.")
    verb: Verb = Field(
        description="What is done: run what is missing, add points, add one that somebody chose, add "
        "seeds, or retry failed trials."
    )
    arguments: dict[str, Any] = Field(description="What the verb needs, such as the number of samples.")
    owner: str = Field(description="Who asked for it.")
    priority: int = Field(description="Higher ones go first; 0 is the default.")
    num_cpus: float = Field(description="CPUs that it takes while it runs.")
    state: JobState = Field(description="Where it is; creating: its sweep is being written.")
    outcome: Outcome | None = Field(description="How it ended; null: it has not.")
    message: str | None = Field(description="Why it failed.")
    finish_failed: bool | None = Field(
        description="Whether the choice of a policy, its video or the report failed after the trials; null: it has not "
        "completed, or an older version ran it."
    )
    num_attempts: int = Field(description="How many driver processes were started for it.")
    stop_requested: bool = Field(description="Whether somebody asked for its end.")
    submitted_at: float
    started_at: float | None
    ended_at: float | None

    def is_of_former(self, created_at: float) -> bool:
        """Whether it was of an earlier sweep of this name: it ended before the present one was created."""
        return self.ended_at is not None and self.ended_at < created_at

    @property
    def log_fields(self) -> dict[str, Any]:
        """What a line of the log that is about this job says besides its message."""
        return {"job": self.id, "sweep": self.sweep, "owner": self.owner or None}

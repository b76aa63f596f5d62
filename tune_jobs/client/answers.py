"""What a service answers, as models: of a newer one, fields that are not known here are left out.

They have the fields of the service's own models, as a test compares; those can't be imported without a database and a
web framework.
"""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from analysis.records import TrialRecord
from analysis.waits import WaitRecord


class _Answer(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class Job(_Answer):
    """One thing to do with one sweep; times are seconds since 1970."""

    id: int
    uid: str
    sweep: str
    verb: str = Field(description="drive, extend, inject, replicate or retry.")
    arguments: dict[str, Any]
    owner: str
    priority: int
    num_cpus: float | None = Field(description="None: an older service on a cluster doesn't say.")
    state: str = Field(description="creating, waiting, running or ended.")
    outcome: str | None = Field(description="completed, failed, stopped or cancelled; None: it has not ended.")
    message: str | None = Field(description="Why it failed.")
    finish_failed: bool | None = Field(
        default=None,
        description="Whether the choice of a policy, its video or the report failed; None: it has not completed, or an "
        "older service doesn't say.",
    )
    num_attempts: int
    stop_requested: bool
    submitted_at: float
    started_at: float | None
    ended_at: float | None


class Summary(_Answer):
    """A sweep in a list; times are seconds since 1970."""

    name: str
    state: str = Field(description="created, running, interrupted or completed.")
    alive: bool = Field(default=False, description="Whether a process runs it now; older services don't say.")
    owner: str | None
    note: str
    tags: list[str]
    job: Job | None = Field(description="Its job that waits or runs, else its last one.")
    algorithm: str
    env: str
    created_at: float
    started_at: float | None
    ended_at: float | None
    num_trials: int
    counts: dict[str, int] = Field(description="Number of trials by status.")
    num_env_steps: int
    max_env_steps: int | None
    env_steps_per_s: float | None
    time_left_s: float | None
    run_time_s: float
    best: dict[str, Any] | None
    waiting: WaitRecord | None = Field(None, description="The nodes of a cluster that it waits for now.")


class Trial(TrialRecord):
    """A trial's record, and its score."""

    score: float | None = Field(description="Of its best checkpoint; None: it can't win.")
    score_point: dict[str, Any] | None = Field(
        None, description="The values that it was reached with; None: those of `point`, as nearly always."
    )


class Curve(_Answer):
    """Points of one trial's learning curve, oldest first."""

    iteration: list[int]
    num_env_steps: list[int]
    training_return: list[float | None]
    evaluation_return: list[float | None]


class Curves(_Answer):
    """The learning curves of a sweep."""

    last_event_id: str = Field(description="The event that they are as of.")
    trials: dict[str, Curve]


class FileOfSweep(_Answer):
    """A file that can be downloaded."""

    path: str = Field(description="What `download` takes.")
    num_bytes: int
    modified_at: float = Field(description="Unix time, seconds.")
    media_type: str


class Submitted(_Answer):
    """A sweep that was submitted."""

    sweep: str
    job: Job


class Planned(_Answer):
    """What would run, as `tune-jobs launch --dry-run --json` prints it."""

    spec: dict[str, Any]
    plan: dict[str, Any]


class Me(_Answer):
    """Who asks, and what service it is."""

    name: str
    role: str = Field(description="viewer, submitter or admin.")
    version: str
    num_cpus: float | None = Field(description="That it runs sweeps on; None: it runs them on a cluster.")
    address: str | None = Field(description="The cluster.")
    spare: Any = Field(None, description="The process that is kept warm for the next sweep.")

"""What comes in and goes out, as models: the OpenAPI document is made of them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from tune_jobs.service.access.audit import Entry
from tune_jobs.service.access.callers import Role
from tune_jobs.service.jobs import MAX_PRIORITY, Job
from tune_jobs.service.submitting import Submission
from tune_jobs.service.summaries import SweepSummary

TEXT = r"^[^\x00]*$"
"""Any text but one with the character of code 0, which PostgreSQL takes in no column."""
Name = Annotated[str, Field(min_length=1, max_length=200)]
Priority = Annotated[int, Field(ge=-MAX_PRIORITY, le=MAX_PRIORITY, description="Higher ones go first.")]
Tags = Annotated[list[Annotated[str, Field(min_length=1, max_length=50, pattern=TEXT)]], Field(max_length=20)]
WAIT_FOR_NODES: dict[str, Any] = {
    "ge": 0,
    "le": 10**9,
    "allow_inf_nan": False,
    "description": "On a cluster: the most seconds to wait until its nodes can hold one trial; its autoscaler is asked "
    "for them. Left out: as the service's operator has said.",
}
Note = Annotated[str, Field(max_length=2_000, pattern=TEXT, description="A text for people.")]


class _Request(BaseModel):
    # JSON has types: a text of digits is no number, and true is not 1.
    model_config = ConfigDict(extra="forbid", strict=True)


class NewSweep(_Request):
    """A sweep to be validated, planned or submitted: exactly one of preset, text and spec."""

    preset: str | None = Field(None, max_length=200, description="Name of a preset.")
    text: str | None = Field(None, max_length=1_000_000, description="A sweep file, YAML.")
    spec: dict[str, Any] | None = Field(None, description="The content of a sweep file.")
    overrides: list[str] = Field(default_factory=list, max_length=100, description="`a.b=value`, as for --set.")
    name: Name | None = Field(None, description="Name of the sweep; null: the file's, or one that is free.")
    default_name: Name | None = Field(None, description="Name if the file has none, with a number if it is taken.")
    priority: Priority = 0
    note: Note = ""
    tags: Tags = Field(default_factory=list)
    wait_for_nodes: float | None = Field(None, **WAIT_FOR_NODES)

    def submission(self) -> Submission:
        """Return it as the submitter has it."""
        return Submission(**{name: getattr(self, name) for name in type(self).model_fields})


class Change(_Request):
    """What may be changed of a sweep; what is left out stays."""

    priority: Priority | None = None
    note: Note | None = None
    tags: Tags | None = None


class Extend(_Request):
    """More points."""

    num_samples: int = Field(ge=1, le=100_000, description="Random draws for each combination of the grids.")


class Inject(_Request):
    """A point that somebody chose."""

    point: dict[str, Any] = Field(
        max_length=1_000,
        description="A value for each searched hyperparameter, by its name; it may lie outside of its domain.",
    )


class Replicate(_Request):
    """More seeds for the leading settings."""

    top: int = Field(5, ge=2, le=1_000, description="How many settings race.")
    seeds: int = Field(5, ge=1, le=1_000, description="How many more seeds a setting gets at most.")


class Counts(BaseModel):
    """Number of trials by status."""

    model_config = ConfigDict(extra="allow")


class SweepPage(BaseModel):
    """A page of sweeps."""

    sweeps: list[SweepSummary]
    next_cursor: str | None = Field(description="Give it as `cursor` for the next page; null: this is the last.")


class TrialPage(BaseModel):
    """A page of trials."""

    trials: list[dict[str, Any]]
    next_cursor: str | None


class Curve(BaseModel):
    """Points of one trial's learning curve, oldest first."""

    iteration: list[int]
    num_env_steps: list[int]
    training_return: list[float | None] = Field(description="Mean of the last 100 exploring episodes; null: none yet.")
    evaluation_return: list[float | None] = Field(description="Mean of greedy episodes; null: not evaluated there.")


class CurvesOfSweep(BaseModel):
    """The learning curves of a sweep."""

    last_event_id: str = Field(description="The event that they are as of.")
    trials: dict[str, Curve] = Field(description="By the trial's id; trials without results are left out.")


class FileOfSweep(BaseModel):
    """A file that can be downloaded."""

    path: str = Field(description="Behind `/api/v1/sweeps/{name}/`.")
    num_bytes: int
    modified_at: float = Field(description="Unix time, seconds.")
    media_type: str


class Submitted(BaseModel):
    """A sweep that was submitted."""

    sweep: str
    job: Job


class Planned(BaseModel):
    """What would run."""

    spec: dict[str, Any]
    plan: dict[str, Any]


class Health(BaseModel):
    """Whether the service lives."""

    status: Literal["ok"]


class Ready(BaseModel):
    """Whether the service takes requests."""

    status: Literal["ready", "draining", "not ready"]
    problems: list[str]


class Login(_Request):
    """A token, in exchange for a cookie."""

    token: str = Field(min_length=1, max_length=500, description="The token, as it was shown when it was made.")


class LoggedIn(BaseModel):
    """Who has logged in."""

    name: str
    role: Role


class AuditPage(BaseModel):
    """A page of the audit log."""

    entries: list[Entry]
    next_cursor: str | None

"""Sweeps and trials as the service answers them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from pydantic import BaseModel, Field

from analysis.records import TrialRecord, TrialStatus
from analysis.waits import WaitRecord
from policies.errors import SpecError
from tune_jobs.service.jobs import Job
from tune_jobs.service.labels import Label
from tune_jobs.service.statuses import Seen
from tune_jobs.sweeps.plain import score_point, to_json


class SweepSummary(BaseModel):
    """A sweep in a list."""

    name: str
    state: str = Field(description="created, running, interrupted, completed.")
    alive: bool = Field(description="Whether a process runs it now; after its trials, that writes the result.")
    owner: str | None = Field(description="Who submitted it; null: nobody did, here.")
    note: str
    tags: list[str]
    job: Job | None = Field(description="Its job that waits or runs, else its last one.")
    algorithm: str
    env: str
    created_at: float
    started_at: float | None
    ended_at: float | None
    num_trials: int
    counts: dict[TrialStatus, int]
    num_env_steps: int
    max_env_steps: int | None
    env_steps_per_s: float | None
    time_left_s: float | None
    run_time_s: float
    best: dict[str, Any] | None
    waiting: WaitRecord | None = Field(description="The nodes of a cluster that it waits for now; null: it does not.")


def summary(seen: Seen, label: Label, job: Job | None) -> SweepSummary:
    """Return a sweep as a list shows it, with what the database has under its name."""
    status, record = seen.status, seen.status.sweep
    env = record.spec.get("env", {})
    # Of an earlier sweep of this name, whose folder somebody removed, neither says anything of this one.
    label = label.of(record.created_at)
    if job is not None and job.is_of_former(record.created_at):
        job = None
    return SweepSummary(
        name=record.name,
        state=status.state,
        alive=status.alive,
        owner=label.owner,
        note=label.note,
        tags=list(label.tags),
        job=job,
        algorithm=str(record.spec.get("algorithm", "")),
        env=str(env.get("id", "") if isinstance(env, dict) else env),
        created_at=record.created_at,
        started_at=record.started_at,
        ended_at=record.ended_at,
        num_trials=record.num_trials,
        counts=status.counts,
        num_env_steps=status.num_env_steps,
        max_env_steps=status.max_env_steps,
        env_steps_per_s=status.env_steps_per_s,
        time_left_s=status.time_left_s,
        run_time_s=record.run_time_s,
        best=None if status.best is None else to_json(status.best),
        waiting=status.waits_for,
    )


def jobs_by_sweep(jobs: Iterable[Job]) -> dict[str, Job]:
    """Return the job of each sweep that matters, of jobs in the order in which they came.

    It is the first that waits or runs, else the last that ended.
    """
    chosen: dict[str, Job] = {}
    for job in jobs:
        known = chosen.get(job.sweep)
        if known is None or known.state == "ended":
            chosen[job.sweep] = job
    return chosen


def trial_row(record: TrialRecord, score: float | None, fields: Sequence[str] | None = None) -> dict[str, Any]:
    """Return a trial's record, its score and `score_point`, or these fields of them alone."""
    if fields is None:
        row: dict[str, Any] = to_json(record)
        return row | {"score": score, "score_point": score_point(record)}

    def value(name: str) -> Any:
        if name == "score":
            return score
        return score_point(record) if name == "score_point" else to_json(getattr(record, name))

    return {name: value(name) for name in fields}


def check_sort(name: str, records: Sequence[TrialRecord]) -> None:
    """Check that trials can be sorted by something.

    Raises:
        SpecError: It is no field of theirs, and no hyperparameter that is searched.
    """
    fields = TrialRecord.model_fields
    # Nearly always the first record has it.
    if name == "score" or name in fields or any(name in record.point for record in records):
        return
    searched = {searched for record in records for searched in record.point}
    raise SpecError(
        f"sort: trials have no column {name[:80]!r}.",
        f"They have {', '.join(['score', *sorted(searched), *sorted(fields)])}.",
    )


def wanted_fields(text: str) -> list[str]:
    """Return the names of a trial's fields that a text lists, separated by commas.

    Raises:
        SpecError: It has no such field.
    """
    known = {*TrialRecord.model_fields, "score", "score_point"}
    names = text.split(",")
    for name in names:
        if name not in known:
            raise SpecError(f"fields: a trial has no field {name[:80]!r}.", f"It has {', '.join(sorted(known))}.")
    return names

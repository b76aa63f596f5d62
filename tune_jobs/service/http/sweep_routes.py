"""Sweeps: submit, look, change, delete."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Header, Query, Response

from analysis.records import TrialRecord
from analysis.selection import score_trial
from policies.errors import NotFoundError
from tune_jobs.service.http.caller import AChanger, ASubmitter, TheService
from tune_jobs.service.http.models import (
    Change,
    NewSweep,
    Planned,
    Submitted,
    SweepPage,
    SweepSummary,
    TrialPage,
)
from tune_jobs.service.http.pages import page_of
from tune_jobs.service.http.problems import NotNowError, TooManyError
from tune_jobs.service.jobs import Job
from tune_jobs.service.labels import NOTHING, Label
from tune_jobs.service.service import Service
from tune_jobs.service.statuses import Seen
from tune_jobs.sweeps.plain import to_json

router = APIRouter(prefix="/api/v1", tags=["sweeps"])

Limit = Annotated[int, Query(ge=1, le=1_000, description="The most items of a page.")]
Cursor = Annotated[str | None, Query(max_length=2_000, description="`next_cursor` of the page before.")]
Order = Annotated[Literal["asc", "desc"], Query(description="The order of the sort.")]


@router.post("/plans")
def plan(new: NewSweep, service: TheService, _: ASubmitter) -> Planned:
    """Validate a sweep and say what would run; nothing is written."""
    spec, made = service.submitter.plan(new.submission())
    return Planned(spec=spec.model_dump(mode="json"), plan=to_json(made.to_json()))


@router.post("/sweeps", status_code=201, responses={200: {"description": "The key was used for this before."}})
def submit(
    new: NewSweep,
    service: TheService,
    caller: ASubmitter,
    response: Response,
    idempotency_key: Annotated[str | None, Header(max_length=200)] = None,
) -> Submitted:
    """Write a sweep, and let it wait for its turn."""
    _check_room(service, caller.name)
    job, is_new = service.submitter.submit(new.submission(), owner=caller.name, key=idempotency_key)
    if is_new:
        service.labels.change(job.sweep, owner=caller.name, note=new.note, tags=new.tags)
        service.supervisor.wake()
    else:
        response.status_code = 200
    response.headers["Location"] = f"/api/v1/sweeps/{job.sweep}"
    return Submitted(sweep=job.sweep, job=job)


def _check_room(service: Service, owner: str) -> None:
    limit = service.config.limits.sweeps
    if limit is None:
        return
    count = sum(job.owner == owner for job in service.queue.jobs("creating", "waiting", "running"))
    if count >= limit:
        raise TooManyError(
            f"{owner} has {count:,} sweeps that wait or run; here a person may have {limit:,}.",
            "Wait until one has ended, or stop one.",
        )


_SORTS: dict[str, Callable[[SweepSummary], Any]] = {
    "name": lambda item: item.name,
    "created_at": lambda item: item.created_at,
    "state": lambda item: item.state,
    "num_env_steps": lambda item: item.num_env_steps,
    "best": lambda item: None if item.best is None else item.best["score"],
}


@router.get("/sweeps")
def sweeps(
    service: TheService,
    *,
    state: Annotated[str | None, Query(max_length=100)] = None,
    owner: Annotated[str | None, Query(max_length=100)] = None,
    tag: Annotated[str | None, Query(max_length=50)] = None,
    search: Annotated[str | None, Query(max_length=100, description="A part of the name, the env or the note.")] = None,
    sort: Literal["name", "created_at", "state", "num_env_steps", "best"] = "created_at",
    order: Order = "desc",
    limit: Limit = 100,
    cursor: Cursor = None,
) -> SweepPage:
    """List sweeps."""
    labels = service.labels.all()
    jobs = _jobs_by_sweep(service)
    found = [
        _summary(seen, labels.get(seen.status.sweep.name, NOTHING), jobs.get(seen.status.sweep.name))
        for seen in service.statuses.all()
    ]
    wanted = [
        item
        for item in found
        if (state is None or item.state == state)
        and (owner is None or item.owner == owner)
        and (tag is None or tag in item.tags)
        and (search is None or search.lower() in f"{item.name} {item.env} {item.note}".lower())
    ]
    page, following = page_of(
        wanted,
        key=_SORTS[sort],
        identity=lambda item: item.name,
        descending=order == "desc",
        cursor=cursor,
        limit=limit,
    )
    return SweepPage(sweeps=page, next_cursor=following)


@router.get("/sweeps/{name}")
def sweep(name: str, service: TheService) -> SweepSummary:
    """Return one sweep."""
    return summary_of(service, name)


@router.get("/sweeps/{name}/spec")
def spec(name: str, service: TheService) -> dict[str, Any]:
    """Return the sweep file's content, with defaults."""
    return service.statuses.see(name).status.sweep.spec


@router.patch("/sweeps/{name}")
def change(name: str, to: Change, service: TheService, _: AChanger) -> SweepSummary:
    """Change the priority, the note or the tags."""
    service.statuses.see(name)
    if to.priority is not None:
        service.queue.set_priority(name, to.priority)
        service.supervisor.wake()
    if to.note is not None or to.tags is not None:
        service.labels.change(name, note=to.note, tags=to.tags)
    return summary_of(service, name)


@router.delete("/sweeps/{name}", status_code=204)
def delete(
    name: str,
    service: TheService,
    _: AChanger,
    force: Annotated[bool, Query(description="Also one that has not finished.")] = False,  # noqa: FBT002
) -> None:
    """Delete a sweep with all that it has made."""
    seen = service.statuses.see(name)
    if seen.status.alive or service.queue.jobs("waiting", "running", "creating", sweep=name):
        raise NotNowError(f"Sweep {name} waits or runs.", "Stop it first.")
    if seen.status.state != "completed" and not force:
        raise NotNowError(
            f"Sweep {name} has not finished: it is {seen.status.state}.", "Resume it, or delete it with force=true."
        )
    service.storage.sweep(name).delete()
    service.queue.remove_sweep(name)
    service.labels.forget(name)
    service.statuses.forget(name)


@router.get("/sweeps/{name}/trials")
def trials(
    name: str,
    service: TheService,
    *,
    status: Annotated[str | None, Query(max_length=100)] = None,
    sort: Annotated[str, Query(max_length=200, description="score, a column, or a searched hyperparameter.")] = "score",
    order: Order = "desc",
    limit: Limit = 100,
    cursor: Cursor = None,
) -> TrialPage:
    """List the trials of a sweep."""
    found = [
        _trial_row(trial) for trial in service.statuses.see(name).trials if status is None or trial.status == status
    ]

    def key(row: dict[str, Any]) -> Any:
        value = row["point"].get(sort) if sort in row["point"] else row.get(sort)
        return value if value is None or isinstance(value, str | int | float) else str(value)

    page, following = page_of(
        found,
        key=key,
        identity=lambda row: str(row["trial_id"]),
        descending=order == "desc",
        cursor=cursor,
        limit=limit,
    )
    return TrialPage(trials=page, next_cursor=following)


@router.get("/sweeps/{name}/trials/{trial_id}")
def trial(name: str, trial_id: str, service: TheService) -> dict[str, Any]:
    """Return one trial."""
    for item in service.statuses.see(name).trials:
        if item.trial_id == trial_id:
            return _trial_row(item)
    raise NotFoundError(f"Sweep {name} has no trial {trial_id[:80]!r}.", f"It has {_span(service, name)}.")


def _trial_row(trial: TrialRecord) -> dict[str, Any]:
    scored = score_trial(trial)
    row: dict[str, Any] = to_json(trial)
    return row | {"score": None if scored is None else scored.score}


def _span(service: Service, name: str) -> str:
    known = [item.trial_id for item in service.statuses.see(name).trials]
    return f"{known[0]} to {known[-1]}" if known else "none"


@router.get("/sweeps/{name}/trials/{trial_id}/iterations")
def iterations(
    name: str,
    trial_id: str,
    service: TheService,
    after: Annotated[int, Query(ge=0, description="Only iterations after this one.")] = 0,
) -> list[dict[str, Any]]:
    """Return what each iteration of a trial showed, without its single episodes."""
    trial(name, trial_id, service)
    found = service.storage.sweep(name).trial(trial_id).read_iterations()
    return [iteration_row(item) for item in found if item.iteration > after]


def iteration_row(item: Any) -> dict[str, Any]:
    """Return an iteration without its single episodes, which are many."""
    row: dict[str, Any] = to_json(item)
    for name in ("episode_returns", "episode_lengths", "mean_return", "std_return"):
        row.pop(name, None)
    return row


@router.get("/sweeps/{name}/trials/{trial_id}/log")
def log(
    name: str,
    trial_id: str,
    service: TheService,
    lines: Annotated[int, Query(ge=1, le=5_000, description="How many lines, of the end.")] = 200,
) -> dict[str, str]:
    """Return the end of what a trial printed."""
    trial(name, trial_id, service)
    return {"text": service.storage.sweep(name).trial(trial_id).log_tail(lines)}


def summary_of(service: Service, name: str) -> SweepSummary:
    """Return one sweep as a list shows it."""
    seen = service.statuses.see(name)
    return _summary(seen, service.labels.of(name), _jobs_by_sweep(service, name).get(name))


def _jobs_by_sweep(service: Service, name: str | None = None) -> dict[str, Job]:
    """Return the job of each sweep that matters: the first that waits or runs, else the last that ended."""
    chosen: dict[str, Job] = {}
    for job in service.queue.jobs(sweep=name):
        known = chosen.get(job.sweep)
        if known is None or known.state == "ended":
            chosen[job.sweep] = job
    return chosen


def _summary(seen: Seen, label: Label, job: Job | None) -> SweepSummary:
    status, record = seen.status, seen.status.sweep
    env = record.spec.get("env", {})
    return SweepSummary(
        name=record.name,
        state=status.state,
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
    )

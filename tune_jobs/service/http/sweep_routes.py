"""Sweeps: submit, look, change, delete."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Header, Query, Request, Response

from analysis.records import IterationRecord, TrialRecord
from policies.errors import CheckpointError, NotFoundError
from tune_jobs.service.access.callers import Caller
from tune_jobs.service.http.caller import (
    AChanger,
    ADeleter,
    ASubmitter,
    ATurn,
    TheService,
    check_changer,
    set_audit_target,
)
from tune_jobs.service.http.models import (
    Change,
    NewSweep,
    Planned,
    Submitted,
    SweepPage,
    TrialPage,
)
from tune_jobs.service.http.pages import MAX_CURSOR, page_of
from tune_jobs.service.http.problems import NotNowError, TooManyError
from tune_jobs.service.jobs import Job
from tune_jobs.service.labels import NOTHING
from tune_jobs.service.problem_documents import problems
from tune_jobs.service.service import Service
from tune_jobs.service.statuses import Seen
from tune_jobs.service.summaries import SweepSummary, check_sort, jobs_by_sweep, summary, trial_row, wanted_fields
from tune_jobs.sweeps.plain import to_json

router = APIRouter(prefix="/api/v1", tags=["sweeps"])

Limit = Annotated[int, Query(ge=1, le=1_000, description="The most items of a page.")]
Cursor = Annotated[str | None, Query(max_length=MAX_CURSOR, description="`next_cursor` of the page before.")]
Order = Annotated[Literal["asc", "desc"], Query(description="The order of the sort.")]

_EPISODES = frozenset({"episode_returns", "episode_lengths"})


@router.post(
    "/plans",
    responses=problems({429: "Too many sweeps are being planned, or too many wrong tokens were shown."}),
)
def plan(new: NewSweep, service: TheService, turn: ATurn) -> Planned:
    """Validate a sweep and say what would run; nothing is written."""
    spec, made = service.submitter.plan(new.submission())
    answer = Planned(spec=spec.model_dump(mode="json"), plan=to_json(made.to_json()))
    # Not when it has been read, for which a client may take its time.
    turn.end()
    return answer


@router.post(
    "/sweeps",
    status_code=201,
    responses={
        200: {"model": Submitted, "description": "The key was used for this before."},
        **problems(
            {429: "You have as many sweeps as you may, too many are being planned, or wrong tokens were shown."}
        ),
    },
)
def submit(
    new: NewSweep,
    service: TheService,
    caller: ASubmitter,
    turn: ATurn,
    *,
    request: Request,
    response: Response,
    idempotency_key: Annotated[
        str | None,
        Header(min_length=1, max_length=200, description="One for each sweep; a repeated request has the same."),
    ] = None,
) -> Submitted:
    """Write a sweep, and let it wait for its turn."""

    def say_whose(job: Job, created_at: float) -> None:
        set_audit_target(request, job.sweep)
        _say_whose(service, caller, new, job, created_at)

    job, is_new = service.submitter.submit(
        new.submission(),
        owner=caller.name,
        key=idempotency_key,
        check_room=lambda: _check_room(service, caller.name),
        on_made=say_whose,
    )
    turn.end()
    set_audit_target(request, job.sweep)
    if is_new:
        service.supervisor.wake()
    else:
        _say_whose_again(service, caller, new, job)
        response.status_code = 200
    response.headers["Location"] = f"/api/v1/sweeps/{job.sweep}"
    return Submitted(sweep=job.sweep, job=job)


def _say_whose(service: Service, caller: Caller, new: NewSweep, job: Job, created_at: float) -> None:
    service.labels.change(job.sweep, owner=caller.name, note=new.note, tags=new.tags, created_at=created_at)


def _say_whose_again(service: Service, caller: Caller, new: NewSweep, job: Job) -> None:
    """Say whose a sweep is that a repeated request asks for: the first one may have been killed before it did.

    Raises:
        CheckpointError: Nobody has said whose it is, and it can't be read, so this can't be said now, either.
    """
    # Whoever is creating it says so once it is written.
    if job.state == "creating":
        return
    known = service.labels.of(job.sweep)
    # What was said of a sweep that was created before is said of another one, whose name was free again.
    if known.owner is not None and (known.created_at is None or known.created_at >= job.submitted_at):
        return
    try:
        created_at = service.storage.sweep(job.sweep).read_record().created_at
    except CheckpointError:
        raise
    except NotFoundError:
        # Its folder has been removed since.
        return
    # Its name may be another one's.
    if job.submitted_at <= created_at and not job.is_of_former(created_at):
        _say_whose(service, caller, new, job, created_at)


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
    state: Annotated[str | None, Query(max_length=100, description="Only those in this state.")] = None,
    owner: Annotated[str | None, Query(max_length=100, description="Only this person's.")] = None,
    tag: Annotated[str | None, Query(max_length=50, description="Only those with this tag.")] = None,
    search: Annotated[str | None, Query(max_length=100, description="A part of the name, the env or the note.")] = None,
    sort: Annotated[
        Literal["name", "created_at", "state", "num_env_steps", "best"], Query(description="What they are sorted by.")
    ] = "created_at",
    order: Order = "desc",
    limit: Limit = 100,
    cursor: Cursor = None,
) -> SweepPage:
    """List sweeps."""
    labels = service.labels.all()
    jobs = jobs_by_sweep(service.queue.jobs())
    found = [summary(seen, labels.get(seen.name, NOTHING), jobs.get(seen.name)) for seen in service.statuses.all()]
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


@router.patch("/sweeps/{name}", responses=problems({409: "The priority is to change, and no job of the sweep waits."}))
def change(name: str, to: Change, service: TheService, _: AChanger) -> SweepSummary:
    """Change the priority of what waits, the note or the tags."""
    created_at = service.statuses.see(name).status.sweep.created_at
    if to.priority is not None:
        if not service.queue.set_priority(name, to.priority):
            runs = bool(service.queue.jobs("running", sweep=name))
            raise NotNowError(
                f"Sweep {name} has no job that waits, and the priority says which of those is next: "
                f"{'its job runs already' if runs else 'nothing of it is to be run'}.",
                "Leave the priority out. A job that is added, as by `resume` or `extend`, has that of the last one; "
                "change it while it waits.",
            )
        service.supervisor.wake()
    if to.note is not None or to.tags is not None:
        service.labels.change(name, note=to.note, tags=to.tags, created_at=created_at)
    return summary_of(service, name)


@router.delete(
    "/sweeps/{name}", status_code=204, responses=problems({409: "The sweep waits or runs, or has not finished."})
)
def delete(
    name: str,
    service: TheService,
    caller: ADeleter,
    force: Annotated[bool, Query(description="Also one that has not finished, or is damaged.")] = False,  # noqa: FBT002
) -> None:
    """Delete a sweep with all that it has made."""
    stored = service.storage.sweep(name)
    seen = _seen_to_delete(service, caller, name, force=force)
    if stored.is_driven() or service.queue.jobs("waiting", "running", "creating", sweep=name):
        raise NotNowError(f"Sweep {name} waits or runs.", "Stop it first.")
    if seen is not None and seen.status.state != "completed" and not force:
        raise NotNowError(
            f"Sweep {name} has not finished: it is {seen.status.state}.", "Resume it, or delete it with force=true."
        )
    # A damaged one does not say when that was, nor may its label: then 0, before all sweeps.
    created_at = seen.status.sweep.created_at if seen is not None else service.labels.of(name).created_at or 0.0
    stored.delete()
    if seen is not None:
        # It may have been run from a terminal, and nobody has asked for metrics since.
        service.env_steps.saw(seen)
    service.queue.remove_sweep(name)
    # Its name may be another one's by now.
    service.labels.forget(name, created_at)
    service.statuses.forget(name)


def _seen_to_delete(service: Service, caller: Caller, name: str, *, force: bool) -> Seen | None:
    """Return a sweep that somebody may delete; None: it is damaged."""
    try:
        seen = service.statuses.see(name)
    except CheckpointError as error:
        # Nothing says how far it got; to remove it, nothing of it has to be read.
        if not force:
            raise CheckpointError(error.message, f"{error.hint} With force=true, this deletes the sweep.") from error
        return None
    # It may not have been readable when it was asked whose it is.
    check_changer(service, caller, name, seen)
    return seen


@router.get("/sweeps/{name}/trials")
def trials(
    name: str,
    service: TheService,
    *,
    status: Annotated[str | None, Query(max_length=100, description="Only those in this status.")] = None,
    sort: Annotated[str, Query(max_length=200, description="score, a column, or a searched hyperparameter.")] = "score",
    order: Order = "desc",
    fields: Annotated[
        str | None, Query(max_length=1_000, description="Only these fields of each, separated by commas.")
    ] = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> TrialPage:
    """List the trials of a sweep."""
    known = service.statuses.see(name).trials
    wanted = None if fields is None else wanted_fields(fields)
    check_sort(sort, known.records)

    def key(record: TrialRecord) -> Any:
        if sort == "score":
            return known.scores[record.trial_id]
        value = record.point[sort] if sort in record.point else getattr(record, sort, None)
        return value if value is None or isinstance(value, str | int | float) else str(value)

    page, following = page_of(
        (record for record in known.records if status is None or record.status == status),
        key=key,
        identity=lambda record: record.trial_id,
        descending=order == "desc",
        cursor=cursor,
        limit=limit,
    )
    rows = [trial_row(record, known.scores[record.trial_id], wanted) for record in page]
    return TrialPage(trials=rows, next_cursor=following)


@router.get("/sweeps/{name}/trials/{trial_id}")
def trial(name: str, trial_id: str, service: TheService) -> dict[str, Any]:
    """Return one trial."""
    known = service.statuses.see(name).trials
    for record in known.records:
        if record.trial_id == trial_id:
            return trial_row(record, known.scores[trial_id])
    span = f"{known.records[0].trial_id} to {known.records[-1].trial_id}" if known.records else "none"
    raise NotFoundError(f"Sweep {name} has no trial {trial_id[:80]!r}.", f"It has {span}.")


@router.get("/sweeps/{name}/trials/{trial_id}/iterations")
def iterations(
    name: str,
    trial_id: str,
    service: TheService,
    after: Annotated[int, Query(ge=0, description="Only iterations after this one.")] = 0,
) -> list[dict[str, Any]]:
    """Return what each iteration of a trial showed, without its single episodes."""
    trial(name, trial_id, service)
    return [iteration_row(item) for item in service.storage.sweep(name).trial(trial_id).read_iterations(after)]


def iteration_row(item: IterationRecord) -> dict[str, Any]:
    """Return an iteration without its single episodes, which are many."""
    row: dict[str, Any] = to_json({field: value for field, value in item if field not in _EPISODES})
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
    job = jobs_by_sweep(service.queue.jobs(sweep=name)).get(name)
    return summary(seen, service.labels.of(name), job)

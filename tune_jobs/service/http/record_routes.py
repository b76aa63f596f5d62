"""Sweeps and trials as records, whole: what a command of another machine needs to print what it prints on this one."""

from __future__ import annotations

import json
from dataclasses import fields
from typing import Annotated, Any

from fastapi import APIRouter, Query, Response
from fastapi import Path as PathParameter
from pydantic import StringConstraints
from pydantic_core import to_json

from analysis.records import Objective
from tune_jobs.service.http.caller import TheService
from tune_jobs.service.http.pages import MAX_CURSOR, page_of
from tune_jobs.service.http.waiting import waits_aside
from tune_jobs.service.jobs import Job
from tune_jobs.service.problem_documents import problems
from tune_jobs.sweeps.status import SweepStatus

router = APIRouter(prefix="/api/v1", tags=["records"])


Source = Annotated[str, StringConstraints(max_length=500)]
_MOST_SOURCES = 100


def _json(kind: str, what: str) -> dict[int | str, dict[str, Any]]:
    return {200: {"content": {"application/json": {"schema": {"type": kind}}}, "description": what}}


@router.get("/sweeps/{name}/status", responses=_json("object", "The status."), response_class=Response)
def status(name: str, service: TheService) -> Response:
    """Return the status of a sweep with its whole record; numbers that JSON lacks are texts, as in its files."""
    return _answer(_plain(service.statuses.see(name).status))


@router.get("/statuses", responses=_json("object", "A page of them."), response_class=Response)
def statuses(
    service: TheService,
    *,
    limit: Annotated[int, Query(ge=1, le=1_000, description="The most items of a page.")] = 100,
    cursor: Annotated[str | None, Query(max_length=MAX_CURSOR, description="`next_cursor` of the page before.")] = None,
) -> Response:
    """Return the status of each sweep, by name, as `status` does of one."""
    page, following = page_of(
        service.statuses.all(),
        key=lambda seen: seen.name,
        identity=lambda seen: seen.name,
        descending=False,
        cursor=cursor,
        limit=limit,
    )
    return _answer({"statuses": [_plain(seen.status) for seen in page], "next_cursor": following})


@router.get("/sweeps/{name}/records", responses=_json("array", "The records, by index."), response_class=Response)
@waits_aside
def records(name: str, service: TheService) -> Response:
    """Return the records of all trials with the checkpoints that may be chosen; of a running sweep as a while ago."""
    return Response(service.derived.records(name), media_type="application/json")


@router.get("/sweeps/{name}/what-mattered", responses=_json("object", "What mattered."), response_class=Response)
@waits_aside
def what_mattered(name: str, service: TheService) -> Response:
    """Say which hyperparameters scores depend on, as `importance` does, with the numbers that JSON lacks as texts."""
    return _answer(service.derived.importance(name))


@router.get(
    "/comparison",
    responses={**_json("object", "The comparison."), **problems({404: "There is no such sweep or trial."})},
    response_class=Response,
)
@waits_aside
def comparison(
    service: TheService,
    *,
    source: Annotated[
        list[Source],
        Query(min_length=1, max_length=_MOST_SOURCES, description="A sweep, or one of its trials: NAME/t0003."),
    ],
    objective: Annotated[Objective | None, Query(description="What all are judged by; none: as they say.")] = None,
    top: Annotated[int, Query(ge=2, le=10_000, description="Settings of a sweep that is named alone.")] = 3,
) -> Response:
    """Compare sweeps or settings, as `tune-jobs compare`; of running ones as of a while ago.

    Numbers that JSON lacks are texts.
    """
    parts = [text.rstrip("/").partition("/") for text in source]
    return _answer(service.derived.compared([(name, trial or None) for name, _, trial in parts], objective, top))


@router.get("/jobs/{number}", responses=problems({404: "There is no such job."}))
def job(number: Annotated[int, PathParameter(ge=1, le=2**53, description="Its id.")], service: TheService) -> Job:
    """Return one job."""
    return service.queue.job(number)


def _plain(status: SweepStatus) -> dict[str, Any]:
    # Where the sweep is concerns this machine alone.
    found = {field.name: getattr(status, field.name) for field in fields(status) if field.name != "place"}
    return {**found, "sweep": json.loads(status.sweep.model_dump_json())}


def _answer(content: Any) -> Response:
    return Response(to_json(content, inf_nan_mode="strings"), media_type="application/json")

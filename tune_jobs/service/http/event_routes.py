"""Sweeps as they change: events, and the curves that they continue."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Response
from pydantic_core import to_json

from tune_jobs.service.http.caller import TheService
from tune_jobs.service.http.event_stream import EventStream
from tune_jobs.service.http.models import CurvesOfSweep
from tune_jobs.service.http.waiting import waits_aside
from tune_jobs.service.problem_documents import problems

router = APIRouter(prefix="/api/v1", tags=["events"])

LastId = Annotated[
    str | None, Header(alias="Last-Event-ID", max_length=200, description="The id of the last event that came.")
]
LastIdAgain = Annotated[
    str | None, Query(alias="last_event_id", max_length=200, description="For a first request; the header goes first.")
]
_STREAM: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/event-stream": {"schema": {"type": "string"}}}, "description": "Server-sent events."},
    **problems({429: "As many clients watch as may, or too many wrong tokens came from this address."}),
}


@router.get("/sweeps/{name}/curves", responses={200: {"model": CurvesOfSweep}})
@waits_aside
def curves(
    name: str,
    service: TheService,
    points: Annotated[
        int, Query(ge=2, le=10_000, description="The most points of a trial; others are left out.")
    ] = 200,
) -> Response:
    """Return the learning curves of all trials, in columns, and the id of the event that they are as of.

    To follow a sweep: ask for the curves, then for the trials, then for the events since `last_event_id`. On an event
    `reset`, do so again.
    """
    last_id, found = service.watching.sweep(name).curves(points)
    body = to_json({"last_event_id": last_id, "trials": found}, inf_nan_mode="null")
    return Response(body, media_type="application/json")


@router.get("/sweeps/{name}/events", status_code=200, responses=_STREAM, response_class=EventStream)
@waits_aside
def sweep_events(
    name: str, service: TheService, last_event_id: LastId = None, last_id: LastIdAgain = None
) -> EventStream:
    """Tell what changes of a sweep, as server-sent events, until it is deleted or the service ends.

    `status`: the sweep as in the list. `job`: one of its jobs. `trials`: records of trials that have changed.
    `iterations`: new points of curves, by trial; points that are known of iterations later than `after` are no more.
    `reset`: what came since the given event is not known any more; ask for all anew. `deleted`: the last event.
    """
    return EventStream(service.watching, service.watching.sweep(name).log, last_event_id or last_id or None)


@router.get("/events", status_code=200, responses=_STREAM, response_class=EventStream)
@waits_aside
def list_events(service: TheService, last_event_id: LastId = None, last_id: LastIdAgain = None) -> EventStream:
    """Tell what changes in the list of sweeps, as server-sent events.

    `sweeps`: those that have changed or are new. `deleted`: the names of those that are gone. `reset`: what came since
    the given event is not known any more; ask for the list anew. One that begins without an event asks for the list
    when the stream has begun.
    """
    return EventStream(service.watching, service.watching.sweeps().log, last_event_id or last_id or None)

"""What is not about one sweep: jobs, presets, the sweep file's schema, whether the service lives."""

from __future__ import annotations

from importlib.metadata import version
from typing import Annotated, Any

from fastapi import APIRouter, Query, Response
from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError

from tune_jobs.service.http.caller import TheCaller, TheService
from tune_jobs.service.http.models import Health, Ready
from tune_jobs.service.jobs import Job, JobState
from tune_jobs.spec.file import json_schema, list_presets

router = APIRouter(tags=["service"])


@router.get("/healthz")
async def health() -> Health:
    """Say that the process answers."""
    return Health(status="ok")


@router.get("/readyz", responses={503: {"model": Ready}})
def ready(service: TheService, response: Response) -> Ready:
    """Say whether requests are taken and the queue is run."""
    problems = []
    try:
        with service.engine.begin() as connection:
            connection.execute(text("SELECT 1"))
    except SQLAlchemyError:
        problems.append("The database can't be used.")
    if not service.storage_health.is_there():
        problems.append("The storage can't be reached.")
    if not service.supervisor.is_alive:
        problems.append("The queue is not run.")
    if service.supervisor.is_draining:
        response.status_code = 503
        return Ready(status="draining", problems=problems)
    if problems:
        response.status_code = 503
        return Ready(status="not ready", problems=problems)
    return Ready(status="ready", problems=[])


@router.get("/api/v1/me")
def me(service: TheService, caller: TheCaller) -> dict[str, Any]:
    """Say who asks, and what service this is."""
    return {
        "name": caller.name,
        "role": caller.role,
        "version": version("tune-jobs"),
        "num_cpus": service.supervisor.where.num_cpus if service.config.address is None else None,
        "address": service.config.address,
        "spare": service.supervisor.spare(),
    }


@router.get("/api/v1/jobs")
def jobs(
    service: TheService,
    state: Annotated[list[JobState] | None, Query(description="Only those in these states.")] = None,
) -> list[Job]:
    """List jobs, in the order in which they came."""
    return service.queue.jobs(*(state or ()))


@router.get("/api/v1/presets")
def presets() -> list[dict[str, str]]:
    """List the sweep files that come along."""
    return [preset._asdict() for preset in list_presets()]


@router.get("/api/v1/schema")
def schema() -> dict[str, Any]:
    """Return the JSON Schema of the sweep file."""
    return json_schema()

"""What is done with a sweep: stop, resume, extend, inject a point, replicate, retry."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from fastapi import APIRouter, Query

from tune_jobs.service.access.callers import Caller
from tune_jobs.service.growth import Addition, check_growth, num_cpus_after, num_samples_after
from tune_jobs.service.http.caller import AChanger, TheService
from tune_jobs.service.http.models import WAIT_FOR_NODES, Extend, Inject, Replicate
from tune_jobs.service.http.problems import NotNowError
from tune_jobs.service.jobs import Job, Verb
from tune_jobs.service.problem_documents import problems
from tune_jobs.service.service import Service
from tune_jobs.service.submitting import waiting_arguments
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.rules import check_extendable, check_replicable
from tune_jobs.sweeps.adding import new_point

router = APIRouter(
    prefix="/api/v1/sweeps/{name}",
    tags=["actions"],
    responses=problems({409: "It contradicts what the sweep does just now, or was asked for already."}),
)

_NOTHING = Addition()
Wait = Annotated[float | None, Query(**WAIT_FOR_NODES)]


@router.post("/stop", status_code=202)
def stop(name: str, service: TheService, _: AChanger) -> list[Job]:
    """Ask a sweep to stop: its trials save first. What waits is cancelled."""
    seen = service.statuses.see(name)
    changed = service.queue.request_stop(name)
    sweep = service.storage.sweep(name)
    if not any(job.state == "running" for job in changed) and sweep.is_driven():
        # Somebody runs it from a terminal.
        sweep.request_stop()
    elif not changed:
        raise NotNowError(f"Sweep {name} neither waits nor runs: it is {seen.status.state}.")
    service.supervisor.wake()
    return changed


@router.post("/resume", status_code=202)
def resume(name: str, service: TheService, caller: AChanger, wait_for_nodes: Wait = None) -> Job:
    """Run what is missing of a sweep."""
    return _enqueue(service, caller, name, "drive", {}, wait_for_nodes)


@router.post("/retry", status_code=202)
def retry(name: str, service: TheService, caller: AChanger, wait_for_nodes: Wait = None) -> Job:
    """Run failed trials again, from their latest checkpoints, and whatever else is missing."""
    seen = service.statuses.see(name)
    if not seen.status.counts.get("failed"):
        raise NotNowError(f"Sweep {name} has no failed trial.")
    return _enqueue(service, caller, name, "retry", {}, wait_for_nodes)


@router.post("/extend", status_code=202)
def extend(name: str, more: Extend, service: TheService, caller: AChanger, wait_for_nodes: Wait = None) -> Job:
    """Add points to a sweep, and run them."""
    check_extendable(stored_spec(service.statuses.see(name).status.sweep), more.num_samples)
    added = Addition(num_samples=more.num_samples)
    with service.adding:
        num_samples = _check_growth(service, name, added)
        # How many there are to be in all, so that a job that is repeated after a kill adds none twice.
        arguments = {"to_num_samples": num_samples + more.num_samples}
        return _enqueue(service, caller, name, "extend", arguments, wait_for_nodes, added)


@router.post("/trials", status_code=202)
def inject(name: str, chosen: Inject, service: TheService, caller: AChanger, wait_for_nodes: Wait = None) -> Job:
    """Add a point that somebody chose, and train it with all seeds of a point."""
    seen = service.statuses.see(name)
    record, trials = seen.status.sweep, seen.trials.records
    spec = stored_spec(record)
    # As the sweep writes it, so that a request that says the same in other words is known to be the same.
    point = new_point(record, spec, trials, chosen.point, name)
    added = Addition(points=[point])
    with service.adding:
        _check_growth(service, name, added)
        return _enqueue(service, caller, name, "inject", {"point": point}, wait_for_nodes, added)


@router.post("/replicate", status_code=202)
def replicate(name: str, race: Replicate, service: TheService, caller: AChanger, wait_for_nodes: Wait = None) -> Job:
    """Train the leading settings again with fresh seeds."""
    check_replicable(stored_spec(service.statuses.see(name).status.sweep))
    added = Addition(top=race.top, seeds=race.seeds)
    with service.adding:
        _check_growth(service, name, added)
        return _enqueue(service, caller, name, "replicate", race.model_dump(), wait_for_nodes, added)


def _check_growth(service: Service, name: str, more: Addition) -> int:
    """Check the limits; return how many samples the sweep has once its jobs that wait or run are done."""
    # Before the sweep: what a job that ends in between has added is in there.
    jobs = service.queue.jobs("waiting", "running", sweep=name)
    seen = service.statuses.see(name)
    record, spec = seen.status.sweep, stored_spec(seen.status.sweep)
    check_growth(service.config.limits, record, spec, seen.trials.records, jobs=jobs, more=more)
    return num_samples_after(spec, jobs)


def _enqueue(  # noqa: PLR0917 (all of them are one request)
    service: Service,
    caller: Caller,
    name: str,
    verb: Verb,
    arguments: Mapping[str, Any],
    wait_for_nodes: float | None,
    more: Addition = _NOTHING,
) -> Job:
    created_at = service.statuses.see(name).status.sweep.created_at
    wait = waiting_arguments(service.config, wait_for_nodes)
    with service.adding:
        jobs = [job for job in service.queue.jobs(sweep=name) if not job.is_of_former(created_at)]
        for job in jobs:
            if job.state not in ("waiting", "running"):
                continue
            # How long it waits for nodes makes it no other job.
            asked = {key: value for key, value in job.arguments.items() if key != "wait_for_nodes"}
            if job.verb == verb and asked == dict(arguments) and not job.stop_requested:
                raise NotNowError(f"Sweep {name} has that job already: number {job.id}, which is {job.state}.")
        job, _ = service.queue.begin(
            name,
            verb,
            {**arguments, **wait},
            owner=caller.name,
            priority=jobs[-1].priority if jobs else 0,
            num_cpus=_num_cpus(service, name, verb, jobs, more),
        )
    service.supervisor.wake()
    return job


def _num_cpus(service: Service, name: str, verb: Verb, jobs: Sequence[Job], more: Addition) -> float:
    """Return how many CPUs a further job of a sweep takes: its driver plans the sweep for so many.

    They are no fewer than those of the last one, of which a plan may have made more of than its trials need.
    """
    most = service.supervisor.where.num_cpus
    if not jobs:
        return service.supervisor.where.unplanned_cpus
    if not math.isfinite(most):
        return jobs[-1].num_cpus
    seen = service.statuses.see(name)
    record = seen.status.sweep
    wanted = num_cpus_after(
        record,
        stored_spec(record),
        seen.trials.records,
        jobs=[job for job in jobs if job.state in ("waiting", "running")],
        more=more,
        retry_failed=verb == "retry",
    )
    return min(most, max(jobs[-1].num_cpus, wanted))

"""What is done with a sweep: stop, resume, extend, inject a point, replicate, retry."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fastapi import APIRouter

from analysis.records import SweepRecord
from policies.errors import SpecError
from tune_jobs.plan.sweep_plan import num_trials_of
from tune_jobs.service.access.callers import Caller
from tune_jobs.service.http.caller import AChanger, TheService
from tune_jobs.service.http.models import Extend, Inject, Replicate
from tune_jobs.service.http.problems import NotNowError
from tune_jobs.service.jobs import Job, Verb
from tune_jobs.service.problem_documents import problems
from tune_jobs.service.service import Service
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.rules import check_extendable, check_replicable
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.sweeps.adding import new_point

router = APIRouter(
    prefix="/api/v1/sweeps/{name}",
    tags=["actions"],
    responses=problems({409: "It contradicts what the sweep does just now, or was asked for already."}),
)


@router.post("/stop", status_code=202)
def stop(name: str, service: TheService, _: AChanger) -> list[Job]:
    """Ask a sweep to stop: its trials save first. What waits is cancelled."""
    seen = service.statuses.see(name)
    changed = service.queue.request_stop(name)
    sweep = service.storage.sweep(name)
    if not changed and not seen.status.alive:
        raise NotNowError(f"Sweep {name} neither waits nor runs: it is {seen.status.state}.")
    if not changed:
        # Somebody runs it from a terminal.
        sweep.request_stop()
    service.supervisor.wake()
    return changed


@router.post("/resume", status_code=202)
def resume(name: str, service: TheService, caller: AChanger) -> Job:
    """Run what is missing of a sweep."""
    return _enqueue(service, caller, name, "drive", {})


@router.post("/retry", status_code=202)
def retry(name: str, service: TheService, caller: AChanger) -> Job:
    """Run failed trials again, from their latest checkpoints, and whatever else is missing."""
    seen = service.statuses.see(name)
    if not seen.status.counts.get("failed"):
        raise NotNowError(f"Sweep {name} has no failed trial.")
    return _enqueue(service, caller, name, "retry", {})


@router.post("/extend", status_code=202)
def extend(name: str, more: Extend, service: TheService, caller: AChanger) -> Job:
    """Add points to a sweep, and run them."""
    record = service.statuses.see(name).status.sweep
    spec = stored_spec(record)
    check_extendable(spec)
    # How many there are to be in all, so that a job that is repeated after a kill adds none twice.
    num_samples = _num_samples(service, name, spec) + more.num_samples
    _check_limit(service, record, spec, num_samples=num_samples)
    return _enqueue(service, caller, name, "extend", {"to_num_samples": num_samples})


@router.post("/trials", status_code=202)
def inject(name: str, chosen: Inject, service: TheService, caller: AChanger) -> Job:
    """Add a point that somebody chose, and train it with all seeds of a point."""
    seen = service.statuses.see(name)
    record, trials = seen.status.sweep, seen.trials.records
    spec = stored_spec(record)
    # As the sweep writes it, so that a request that says the same in other words is known to be the same.
    point = new_point(record, spec, trials, chosen.point)
    _check_limit(service, record, spec, num_samples=_num_samples(service, name, spec), num_more_points=1)
    return _enqueue(service, caller, name, "inject", {"point": point})


@router.post("/replicate", status_code=202)
def replicate(name: str, race: Replicate, service: TheService, caller: AChanger) -> Job:
    """Train the leading settings again with fresh seeds."""
    check_replicable(stored_spec(service.statuses.see(name).status.sweep))
    return _enqueue(service, caller, name, "replicate", race.model_dump())


def _num_samples(service: Service, name: str, spec: SweepSpec) -> int:
    """Return how many samples a sweep will have, once the jobs that extend it are done."""
    return max(spec.num_samples, *(int(job.arguments["to_num_samples"]) for job in _to_do(service, name, "extend")), 0)


def _to_do(service: Service, name: str, verb: Verb) -> list[Job]:
    return [job for job in service.queue.jobs("waiting", "running", sweep=name) if job.verb == verb]


def _check_limit(
    service: Service, record: SweepRecord, spec: SweepSpec, *, num_samples: int, num_more_points: int = 0
) -> None:
    # Counted as they will be planned: those that there are now may be fewer than the sweep's spec says.
    trials = num_trials_of(
        spec.model_copy(update={"num_samples": num_samples}), record.replications, record.chosen_points
    )
    known = [item.point for item in record.chosen_points]
    waiting = [job for job in _to_do(service, record.name, "inject") if job.arguments["point"] not in known]
    trials += (len(waiting) + num_more_points) * spec.seeds_per_point
    limit = service.config.limits.trials
    if trials > limit:
        raise SpecError(
            f"The sweep would have {trials:,} trials; here a sweep may have at most {limit:,}.", "Add fewer."
        )


def _enqueue(service: Service, caller: Caller, name: str, verb: Verb, arguments: Mapping[str, Any]) -> Job:
    service.statuses.see(name)
    for job in service.queue.jobs("waiting", "running", sweep=name):
        if job.verb == verb and job.arguments == dict(arguments) and not job.stop_requested:
            raise NotNowError(f"Sweep {name} has that job already: number {job.id}, which is {job.state}.")
    last = service.queue.jobs(sweep=name)
    num_cpus = last[-1].num_cpus if last else service.supervisor.num_cpus
    job, _ = service.queue.begin(name, verb, arguments, owner=caller.name, num_cpus=num_cpus)
    service.supervisor.wake()
    return job

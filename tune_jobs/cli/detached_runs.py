"""The commands that run trials, done by a job of a Ray cluster."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click

from policies.errors import SpecError
from tune_jobs.cli.base import losing_what_nobody_reads, stdout_for

if TYPE_CHECKING:
    from tune_jobs.sweeps.detached import DetachedSweep
    from tune_jobs.sweeps.status import SweepStatus


def run_as_job(
    verb: str,
    arguments: Sequence[Any],
    *,
    storage: str | None,
    address: str | None,
    detach: bool,
    finish: bool,
    progress: str,
    wait_for_nodes: float,
    as_json: bool,
    **options: Any,
) -> int:
    """Have a cluster do a command as a job, and print what goes on with it, or show it until its end.

    Returns:
        The exit code.

    Raises:
        TuneJobsError: The sweep or the address is wrong, or the cluster can't or won't run it.
    """
    from tune_jobs.sweeps import detached

    with stdout_for(as_json=as_json):
        if verb == "launch":
            begun = detached.launch_detached(
                arguments[0], overrides=options["overrides"], name=options["name"], storage=storage, address=address,
                finish=finish, wait_for_nodes=wait_for_nodes,
            )  # fmt: skip
        else:
            begun = detached.go_on_detached(
                verb, arguments[0], _words(verb, arguments[1:], options), storage=storage, address=address,
                finish=finish, wait_for_nodes=wait_for_nodes,
            )  # fmt: skip
        try:
            state = detached.wait_until_begun(begun)
        except KeyboardInterrupt:
            # The cluster has it: what is not known yet is shown by `status`.
            detach, state = True, "PENDING"
    if detach:
        with losing_what_nobody_reads(True):  # noqa: FBT003
            _show(begun, state, storage=storage, as_json=as_json)
        return 0
    from tune_jobs.cli.attach_command import show_until_end

    return show_until_end(begun.name, storage=storage, progress=progress, as_json=as_json)


def refuse_dry_run_of_job(address: str | None, *, detach: bool) -> None:
    """Refuse a dry run on a cluster that only takes jobs.

    Raises:
        SpecError: The address is that of a Jobs API, or `--detach` is given.
    """
    from tune_jobs.ray_tune.jobs import is_jobs_address

    if detach or is_jobs_address(address):
        raise SpecError(
            "A dry run does not go with --detach or a cluster's http:// address, which only takes jobs.",
            "Leave both out to plan for this machine, or give ray://HEAD:10001 to plan for the cluster.",
        )


def job_facts(status: SweepStatus) -> dict[str, str] | None:
    """Return id, address and state of the job that drives a sweep or drove it last; None: no job did."""
    if status.sweep.job is None or status.place is None:
        return None
    from tune_jobs.sweeps.detached import job_now, told_of, why_not_asked
    from tune_jobs.sweeps.own_job import job_of

    job = job_of(status.sweep, status.place)
    if job is None:
        return None
    refused = why_not_asked(job)
    state = told_of(job_now(job)) if refused is None else f"not asked. {refused.message} {refused.hint}"
    return {"id": job.id, "address": job.address, "state": state}


def _words(verb: str, arguments: Sequence[Any], options: dict[str, Any]) -> list[str]:
    """Return what a command takes besides its sweep, as its job's shell takes it."""
    match verb:
        case "extend":
            return ["--num-samples", str(arguments[0])]
        case "inject":
            return [f"{name}={json.dumps(value)}" for name, value in arguments[0].items()]
        case "replicate":
            return ["--top", str(options["top"]), "--seeds", str(options["seeds"])]
        case _:
            return ["--retry-failed"] if options["retry_failed"] else []


def _show(begun: DetachedSweep, state: str, *, storage: str | None, as_json: bool) -> None:
    from tune_jobs.cli import output

    at = output.storage_option_of(storage)
    commands = {verb: f"tune-jobs {verb} {shlex.quote(begun.name)}{at}" for verb in ("status", "attach", "stop")}
    if as_json:
        output.print_json({
            "sweep": begun.name, "folder": begun.place, "job": begun.job.id, "address": begun.job.address,
            "state": state.lower(), "commands": commands,
        })  # fmt: skip
        return
    told = {"RUNNING": "runs", "PENDING": "has not begun yet"}.get(state, "has run already")
    click.echo(f"{begun.name}: job {begun.job.id} at {begun.job.address} {told}; this terminal is not needed any more.")
    for verb, command in commands.items():
        click.echo(f"  {verb:8}{command}")

"""The commands that run trials: here, or by a service that is followed until the end."""

from __future__ import annotations

from typing import Any

import click

from tune_jobs.cli.base import losing_what_nobody_reads, result_of, stdout_for
from tune_jobs.cli.server import refuse_options, server_of


def run_verb(
    ctx: click.Context, verb: str, *arguments: Any, storage: str | None, as_json: bool, **options: Any
) -> None:
    """Do a launch, resume, extend, inject or replicate, print its result, and exit with its code.

    Args:
        ctx: The command.
        verb: The name of the function in `tune_jobs.sweeps.verbs`.
        arguments: Those of the function that have no names.
        storage: Folder for sweeps.
        as_json: Whether to print one JSON document.
        options: Further arguments of the function.
    """
    server = server_of()
    if server is not None:
        refuse_options()
        from tune_jobs.cli.remote_runs import run_there

        ctx.exit(run_there(server, verb, arguments, as_json=as_json, **options))
    detach = options.pop("detach", False)
    from tune_jobs.ray_tune.jobs import is_jobs_address

    if detach or is_jobs_address(options["address"]):
        from tune_jobs.cli.detached_runs import run_as_job

        ctx.exit(run_as_job(verb, arguments, storage=storage, detach=detach, as_json=as_json, **options))
    from tune_jobs.cli import output as cli_output
    from tune_jobs.sweeps import verbs as sweeps

    with stdout_for(as_json=as_json):
        result = result_of(getattr(sweeps, verb), *arguments, storage=storage, **options)
    if verb == "extend" and result.interrupted:
        with losing_what_nobody_reads(True):  # noqa: FBT003
            click.echo("The samples are in the sweep by now: extend again would add as many once more.", err=True)
    with losing_what_nobody_reads(result.interrupted):
        cli_output.show_result(result, as_json=as_json)
    ctx.exit(result.exit_code)

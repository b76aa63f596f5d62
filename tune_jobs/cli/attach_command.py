"""The command that shows a sweep which another process drives."""

from __future__ import annotations

import shlex

import click

from tune_jobs.cli.base import (
    json_option,
    losing_what_nobody_reads,
    say_left,
    stdout_for,
    storage_option,
    sweep_argument,
)
from tune_jobs.cli.server import here_only
from tune_jobs.process.interruption import EXIT_CODE as INTERRUPTED


@click.command()
@sweep_argument
@click.option("--progress", type=click.Choice(["auto", "none"]), default="auto", help="Live table or nothing.")
@storage_option
@json_option
@click.pass_context
def attach(ctx: click.Context, /, *, sweep: str, progress: str, storage: str | None, as_json: bool) -> None:
    """Show the live table of a sweep that runs elsewhere, until it ends; Ctrl-C only looks away.

    It takes the storage folder alone, and exits as launch does.
    """
    here_only()
    ctx.exit(show_until_end(sweep, storage=storage, progress=progress, as_json=as_json))


def show_until_end(sweep: str, *, storage: str | None, progress: str, as_json: bool) -> int:
    """Show a sweep until its end, print its result, and return the exit code.

    Raises:
        TuneJobsError: The same as of `attach`.
    """
    from tune_jobs.cli import output

    at = output.storage_option_of(storage)
    try:
        from tune_jobs.sweeps.attach import attach as follow

        with stdout_for(as_json=as_json):
            result = follow(sweep, storage=storage, progress=progress)
    except KeyboardInterrupt:
        name = shlex.quote(sweep)
        hint = f"See it again: tune-jobs attach {name}{at}. Stop it: tune-jobs stop {name}{at}"
        say_left(f"No longer shown; {sweep} goes on.", hint, as_json=as_json)
        return INTERRUPTED
    with losing_what_nobody_reads(result.interrupted):
        output.show_result(result, as_json=as_json)
    return result.exit_code

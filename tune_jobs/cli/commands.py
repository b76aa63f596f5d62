"""The commands: each parses its arguments, calls `tune_jobs.sweeps.verbs`, and prints the result.

Importing this module imports neither ray nor torch, so help, validation and dry runs answer at once. With `--json`,
standard output is one JSON document, also when a command fails; everything else goes to standard error.
"""

from __future__ import annotations

import gc
from typing import TYPE_CHECKING, Any

import click

from policies.errors import SpecError
from policies.standard_streams import standard_streams
from tune_jobs.cli.attach_command import attach
from tune_jobs.cli.base import (
    DEBUG,
    CommandGroup,
    action_option,
    allow_module_option,
    env_option,
    json_option,
    num_episodes_option,
    print_version,
    progress_option,
    run_options,
    set_option,
    source_argument,
    stdout_for,
    storage_option,
    sweep_argument,
)
from tune_jobs.cli.completion import complete_algorithms, complete_presets, complete_specs
from tune_jobs.cli.detached_runs import job_facts, refuse_dry_run_of_job
from tune_jobs.cli.inject_command import inject
from tune_jobs.cli.result_commands import compare, export, importance, report, reproduce
from tune_jobs.cli.running import run_verb
from tune_jobs.cli.serve_command import serve
from tune_jobs.cli.server import here_only, program, remember_server, server_of, server_options, verbs
from tune_jobs.cli.token_commands import token

if TYPE_CHECKING:
    from tune_jobs.sweeps.outcome import Progress

_NEW_OBJECTS = 20_000
"""How many more there are before Python looks for garbage among them; 700 in Python 3.11."""


@click.group(cls=CommandGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.option("--debug", is_flag=True, help="Print the traceback of an error.")
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=print_version,
    help="Print the version.",
)
@server_options
@click.pass_context
def cli(ctx: click.Context, /, *, debug: bool, server: str | None, token_file: str | None, ca_file: str | None) -> None:
    """Hyperparameter search for reinforcement learning: from one sweep file to the best policy on video.

    SPEC is a sweep file or a preset; SWEEP is a sweep's name or folder.

    Exit codes: 0 done, 1 it failed at the service, or an unexpected error, 2 bad sweep file or arguments, 3 some trials
    or the best's confirmation failed, or a reproduced trial differs, 4 no such sweep, trial or checkpoint, 5 cannot run
    here, 130 interrupted.
    """
    ctx.meta[DEBUG] = debug
    remember_server(ctx, server, token_file, ca_file)


@cli.command()
@click.argument("spec", shell_complete=complete_specs)
@set_option
@click.option(
    "--name", help="Name of the sweep.  [default: SPEC's `name`, else the file's or preset's, with a number if taken]"
)
@click.option("--dry-run", is_flag=True, help="Print the plan and start nothing.")
@run_options
@click.pass_context
def launch(
    ctx: click.Context,
    /,
    *,
    spec: str,
    overrides: tuple[str, ...],
    name: str | None,
    dry_run: bool,
    storage: str | None,
    as_json: bool,
    **options: Any,
) -> None:
    """Run a sweep: all trials, then the best policy, its video and a report."""
    if server_of() is None:
        from policies.guard.guard import guarding

        # The guard's child starts while this process still imports its own modules.
        ctx.with_resource(guarding(start=True))
    if dry_run:
        refuse_dry_run_of_job(options["address"], detach=options["detach"])
        from tune_jobs.cli import plan_view as cli_plan

        with stdout_for(as_json=as_json):
            if server_of() is None:
                from tune_jobs.sweeps.dry_run import planned

                where = {option: options[option] for option in ("address", "wait_for_nodes")}
                loaded, plan = planned(spec, overrides, name=name, storage=storage, **where)
            else:
                loaded, plan = verbs().planned(spec, overrides, name=name)
        cli_plan.show_plan(loaded, plan, as_json=as_json, finish=options["finish"])
        return
    run_verb(ctx, "launch", spec, overrides=overrides, name=name, storage=storage, as_json=as_json, **options)


@cli.command(name="list")
@storage_option
@json_option
def list_command(*, storage: str | None, as_json: bool) -> None:
    """List the sweeps of a storage folder."""
    from tune_jobs.cli import output as cli_output

    sweeps = verbs()
    with stdout_for(as_json=as_json):
        statuses = sweeps.list_sweeps(storage)
    cli_output.show_sweeps(statuses, as_json=as_json)


@cli.command()
@sweep_argument
@storage_option
@json_option
def status(*, sweep: str, storage: str | None, as_json: bool) -> None:
    """Say how far a sweep is: its env steps, the best so far, and the time that is left."""
    from tune_jobs.cli import output as cli_output

    sweeps = verbs()
    with stdout_for(as_json=as_json):
        state = sweeps.status(sweep, storage=storage)
        # Who asks a service may have neither a way to the cluster nor its token, and resumes it there, not by a job.
        job = job_facts(state) if server_of() is None else None
    cli_output.show_status(state, program=program(), job=job, as_json=as_json)


@cli.command()
@sweep_argument
@click.option("--sort", metavar="COLUMN", help="Sort by a column, such as score or lr; scores best first.")
@click.option("--top", type=click.IntRange(min=1), metavar="N", help="The first N only; without --sort, by score.")
@storage_option
@json_option
def trials(*, sweep: str, sort: str | None, top: int | None, storage: str | None, as_json: bool) -> None:
    """List the trials of a sweep with their points, scores and errors.

    On a terminal, columns that don't fit are left out, the least important ones first.
    """
    from tune_jobs.cli import trials_table

    sweeps = verbs()

    with stdout_for(as_json=as_json):
        records = sweeps.trials(sweep, storage=storage)
    trials_table.show_trials(records, sort=sort, top=top, as_json=as_json)


@cli.command()
@sweep_argument
@click.option("--retry-failed", is_flag=True, help="Run the failed trials again, too.")
@run_options
@click.pass_context
def resume(ctx: click.Context, /, *, sweep: str, storage: str | None, as_json: bool, **options: Any) -> None:
    """Go on with a sweep that was interrupted: what is done stays, trials go on from their checkpoints.

    Such a trial begins new episodes there, and DQN fills its replay memory anew: its numbers differ from those of a
    trial that nothing has interrupted.
    """
    run_verb(ctx, "resume", sweep, storage=storage, as_json=as_json, **options)


@cli.command()
@sweep_argument
@click.option("--num-samples", type=click.IntRange(min=1), required=True, help="How many more samples to run.")
@run_options
@click.pass_context
def extend(
    ctx: click.Context, /, *, sweep: str, num_samples: int, storage: str | None, as_json: bool, **options: Any
) -> None:
    """Add trials to a sweep: more samples of its space, the earlier points stay as they are.

    If it is interrupted or killed, resume goes on with it; extend again would add as many samples once more.
    """
    run_verb(ctx, "extend", sweep, num_samples, storage=storage, as_json=as_json, **options)


@cli.command()
@sweep_argument
@click.option("--top", type=click.IntRange(min=2), default=5, show_default=True, help="How many leading settings race.")
@click.option(
    "--seeds", type=click.IntRange(min=1), default=5, show_default=True, help="More seeds that a setting gets at most."
)
@run_options
@click.pass_context
def replicate(
    ctx: click.Context, /, *, sweep: str, top: int, seeds: int, storage: str | None, as_json: bool, **options: Any
) -> None:
    """Train the leading settings of a sweep again, with fresh seeds, to see which is the best.

    A race that was interrupted goes on by resume, or by the same command again.
    """
    run_verb(ctx, "replicate", sweep, top=top, seeds=seeds, storage=storage, as_json=as_json, **options)


@cli.command()
@sweep_argument
@storage_option
@json_option
def stop(*, sweep: str, storage: str | None, as_json: bool) -> None:
    """Ask a running sweep to stop; it can be resumed."""
    from tune_jobs.cli import output as cli_output

    sweeps = verbs()
    with stdout_for(as_json=as_json):
        was_running = sweeps.stop(sweep, storage=storage)
        go_on = cli_output.going_on(sweep, storage) if was_running and not as_json else ""
    cli_output.show_stop(sweep, was_running=was_running, go_on=go_on, as_json=as_json)


@cli.command()
@sweep_argument
@num_episodes_option
@progress_option
@allow_module_option
@storage_option
@json_option
def best(*, sweep: str, num_episodes: int, progress: Progress, storage: str | None, as_json: bool) -> None:
    """Choose the best checkpoint, confirm it on fresh seeds and export its policy."""
    from tune_jobs.cli import output as cli_output

    sweeps = verbs()
    with stdout_for(as_json=as_json):
        record = sweeps.best(sweep, storage=storage, num_episodes=num_episodes, progress=progress)
    cli_output.show_best(record, as_json=as_json)


@cli.command()
@source_argument
@num_episodes_option
@click.option("--first-seed", type=click.IntRange(0, 2**32 - 1), help="Seed of the first episode; they count up.")
@env_option
@action_option
@progress_option
@allow_module_option
@storage_option
@json_option
def evaluate(
    *,
    source: str,
    num_episodes: int,
    first_seed: int | None,
    env_id: str | None,
    action: int | tuple[float, ...] | None,
    progress: Progress,
    storage: str | None,
    as_json: bool,
) -> None:
    """Run greedy episodes of a policy, beside a random one.

    SOURCE is a sweep (its best policy), SWEEP/TRIAL such as mysweep/t0003, a checkpoint folder, a policy
    file, or a baseline with --env: 'random', or 'constant' with --action.
    """
    from tune_jobs.cli import output as cli_output
    from tune_jobs.sweeps import verbs as sweeps

    here_only()
    _check_baseline(source, env_id, storage)
    with stdout_for(as_json=as_json):
        policy, random = sweeps.evaluate(
            source,
            storage=storage,
            num_episodes=num_episodes,
            first_seed=first_seed,
            env_id=env_id,
            action=action,
            progress=progress,
        )
    cli_output.show_evaluation(policy, random, as_json=as_json)


@cli.command()
@source_argument
@click.option("-o", "--output", metavar="PATH", help="File to write, as .mp4 and .gif; or a folder, ending with /.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), help="Seed of the episode.")
@env_option
@action_option
@progress_option
@allow_module_option
@storage_option
@json_option
def video(
    *,
    source: str,
    output: str | None,
    seed: int | None,
    env_id: str | None,
    action: int | tuple[float, ...] | None,
    progress: Progress,
    storage: str | None,
    as_json: bool,
) -> None:
    """Film a policy: MP4 and GIF; of a sweep also before and after training side by side.

    SOURCE is as for evaluate.
    """
    from tune_jobs.cli import output as cli_output

    sweeps = verbs()
    _check_baseline(source, env_id, storage)
    with stdout_for(as_json=as_json):
        paths = sweeps.video(
            source, storage=storage, output=output, seed=seed, env_id=env_id, action=action, progress=progress
        )
    cli_output.show_paths(paths, as_json=as_json)


def _check_baseline(source: str, env_id: str | None, storage: str | None) -> None:
    if source in ("random", "constant") and env_id is None:
        from tune_jobs.sweeps.sources import names_baseline

        if names_baseline(source, storage):
            raise SpecError(
                f"A {source} policy has no environment of its own.", "Add --env, such as --env CartPole-v1."
            )


for _command in (attach, compare, export, importance, inject, report, reproduce, serve, token):
    cli.add_command(_command)


@cli.command()
@click.argument("name", required=False, shell_complete=complete_presets)
@json_option
def presets(*, name: str | None, as_json: bool) -> None:
    """List the presets, or print the sweep file of one."""
    from tune_jobs.cli import output as cli_output
    from tune_jobs.spec.file import find_preset, list_presets

    if name is None:
        cli_output.show_presets(list_presets(), as_json=as_json)
    else:
        cli_output.show_preset(find_preset(name), as_json=as_json)


@cli.command()
@click.argument("algorithm", required=False, shell_complete=complete_algorithms)
@json_option
def hyperparams(*, algorithm: str | None, as_json: bool) -> None:
    """List the hyperparameters of ppo, dqn, random or constant, with the names that other libraries have for them.

    Other libraries are Stable-Baselines3 and RLlib; it is said where a name of theirs means something else.
    """
    from tune_jobs.cli import hyperparam_view as cli_hyperparams
    from tune_jobs.spec.hyperparam_table import hyperparam_tables

    cli_hyperparams.show_hyperparams(hyperparam_tables(algorithm), as_json=as_json)


@cli.command()
@json_option
def schema(*, as_json: bool) -> None:  # noqa: ARG001 - a schema is JSON either way
    """Print the JSON Schema of the sweep file, for editors."""
    from tune_jobs.cli.output import print_json
    from tune_jobs.spec.file import json_schema

    print_json(json_schema())


def main() -> None:
    """Entry point of the `tune-jobs` script."""
    from tune_jobs.cli.characters import spell_missing_characters
    from tune_jobs.process.home import name_a_home
    from tune_jobs.process.interruption import end_in_order

    # Most of what a command makes are modules, which stay: looking through them for garbage took a sixth of the time of
    # importing them.
    gc.set_threshold(_NEW_OBJECTS)
    end_in_order()
    name_a_home()
    try:
        with standard_streams():
            spell_missing_characters()
            cli(prog_name="tune-jobs")
    finally:
        # Python looks through all that is left for garbage when it ends, which took a launch 0.7 s of waiting.
        gc.freeze()


if __name__ == "__main__":
    main()

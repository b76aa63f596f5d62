"""The commands about what sweeps gave: compare, export, importance, report, reproduce."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from policies.errors import SpecError
from tune_jobs.cli.base import (
    allow_module_option,
    json_option,
    progress_option,
    source_argument,
    sources_argument,
    stdout_for,
    storage_option,
    sweep_argument,
    sweeps_argument,
)
from tune_jobs.cli.server import here_only, server_of
from tune_jobs.cli.server import verbs as verbs_of_command

if TYPE_CHECKING:
    from analysis.records import Objective
    from tune_jobs.sweeps.exports import Format
    from tune_jobs.sweeps.outcome import Progress

# Not imported from where they are declared, as help would then wait for NumPy; a test compares them.
OBJECTIVES = ("final", "area", "best", "steps_to_threshold")
FORMATS = ("csv", "parquet", "latex", "optuna", "pdf", "svg", "png", "sweep")


@click.command()
@sweeps_argument
@click.option(
    "--format", "kind", type=click.Choice(FORMATS), help="What to write.  [default: as PATH's suffix says, else csv]"
)
@click.option(
    "--out",
    "output",
    metavar="PATH",
    help="Folder (csv, parquet) or file.  [default: SWEEP-csv, SWEEP-parquet, else SWEEP and a suffix, in this folder]",
)
@click.option("--top", type=click.IntRange(min=1), metavar="N", help="Settings of the table (10) or the figure (3).")
@storage_option
@json_option
def export(
    *,
    sweeps: tuple[str, ...],
    kind: Format | None,
    output: str | None,
    top: int | None,
    storage: str | None,
    as_json: bool,
) -> None:
    """Write a sweep as tables, a LaTeX table, an Optuna study, a figure for a paper, or one file to send to somebody.

    csv and parquet are folders of tables: trials, iterations, evaluations, settings. latex is a table of the leading
    settings. sweep is one file (.tunejobs), which the page of any service shows. optuna is a SQLite file. pdf, svg and
    png are learning curves with bands over training seeds, also of several sweeps of one environment.
    """
    from tune_jobs.cli import output as cli_output

    does = verbs_of_command()
    with stdout_for(as_json=as_json):
        paths = does.export(list(sweeps), kind, output=output, top=top, storage=storage)
    cli_output.show_paths(paths, as_json=as_json)


@click.command()
@sources_argument
@click.option(
    "--objective", type=click.Choice(OBJECTIVES), help="What all are judged by.  [default: as their sweep files say]"
)
@click.option(
    "--top", type=click.IntRange(min=2), default=3, show_default=True, help="Settings of a sweep that is named alone."
)
@click.option("--html", metavar="FILE", help="Write a page with figures, too.")
@storage_option
@json_option
def compare(
    *,
    sources: tuple[str, ...],
    objective: Objective | None,
    top: int,
    html: str | None,
    storage: str | None,
    as_json: bool,
) -> None:
    """Compare sweeps by their leading settings, or settings, over training seeds.

    Each of SOURCES is a sweep, or a setting by one of its trials, such as mysweep/t0003. Of one sweep alone the leading
    settings are compared.
    """
    from tune_jobs.cli import comparison_view

    does = verbs_of_command()
    with stdout_for(as_json=as_json):
        found = does.compare(list(sources), objective=objective, top=top, html=html, storage=storage)
    comparison_view.show_comparison(found, html=html, as_json=as_json)


@click.command()
@sweep_argument
@storage_option
@json_option
def importance(*, sweep: str, storage: str | None, as_json: bool) -> None:
    """Say which hyperparameters the scores of a sweep depend on, how sure that is, and which bounds to widen."""
    from tune_jobs.cli import importance_view

    does = verbs_of_command()
    with stdout_for(as_json=as_json):
        found = does.importance(sweep, storage=storage)
    importance_view.show_importance(found, as_json=as_json)


@click.command()
@sweep_argument
@click.option("-o", "--output", metavar="PATH", help="With --server: file, or folder with /, to download the page to.")
@progress_option
@allow_module_option
@storage_option
@json_option
def report(*, sweep: str, output: str | None, progress: Progress, storage: str | None, as_json: bool) -> None:
    """Write the report of a sweep: one HTML page, tables and figures."""
    from tune_jobs.cli import output as cli_output

    if output is not None and server_of() is None:
        raise SpecError("--output goes with --server alone: a report lies in its sweep's folder.", "Leave it out.")
    does = verbs_of_command()
    to = {} if output is None else {"output": output}
    with stdout_for(as_json=as_json):
        path = does.report(sweep, storage=storage, progress=progress, **to)
    cli_output.show_paths({"report": path}, as_json=as_json)


@click.command()
@source_argument
@click.option("--out", "output", metavar="FOLDER", help="Keep the repetition here.  [default: it is removed]")
@click.option("--progress", type=click.Choice(["auto", "none"]), default="auto", help="Live table or nothing.")
@allow_module_option
@storage_option
@json_option
@click.pass_context
def reproduce(
    ctx: click.Context,
    /,
    *,
    source: str,
    output: str | None,
    progress: Progress,
    storage: str | None,
    as_json: bool,
) -> None:
    """Run a trial again from its record, and compare every iteration.

    SOURCE is SWEEP/TRIAL, such as mysweep/t0003, or a trial's folder; it is only read. The exit code is 3 if something
    differs.
    """
    from tune_jobs.cli import comparison_view
    from tune_jobs.sweeps import verbs

    here_only()
    with stdout_for(as_json=as_json):
        found = verbs.reproduce(source, output=output, progress=progress, storage=storage)
    comparison_view.show_repetition(found, as_json=as_json)
    ctx.exit(0 if found.equal else 3)

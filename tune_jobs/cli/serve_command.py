"""The command that runs the service."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

import click

from policies.errors import SpecError
from tune_jobs.cli.base import json_option, storage_option
from tune_jobs.cli.server import here_only
from tune_jobs.process.first import leave_first_place

if TYPE_CHECKING:
    from tune_jobs.service.logs import LogFormat

database_option = click.option(
    "--database", metavar="URL", envvar="TUNE_JOBS_DATABASE", show_envvar=True,
    help="postgresql://USER@HOST/NAME.  [default: an SQLite file in the service's folder]",
)  # fmt: skip
folder_option = click.option(
    "--folder", type=click.Path(file_okay=False, path_type=Path), metavar="FOLDER",
    help="The service's own, for its database and logs.  [default: .service in the storage folder]",
)  # fmt: skip


@click.command()
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option("--port", type=click.IntRange(0, 65535), default=8470, show_default=True, help="0: any free port.")
@click.option(
    "--address",
    metavar="ADDRESS",
    help="Ray cluster of all sweeps: auto, HOST:PORT or ray://...; without it, this machine.",
)
@click.option(
    "--wait-for-nodes", type=click.FloatRange(0, 10**9), default=0.0, show_default=True, metavar="SECONDS",
    help="With --address: how long sweeps wait for nodes that can hold one trial, unless their request says it.",
)  # fmt: skip
@database_option
@folder_option
@click.option("--env", "envs", multiple=True, metavar="PATTERN", help="Env ids that sweeps may name; may be repeated.")
@click.option(
    "--allow-module", "modules", multiple=True, metavar="NAME",
    help="Let sweeps name environments and RLModules of this Python module. May be repeated.",
)  # fmt: skip
@click.option(
    "--spare-idle", "spare_idle_s", type=click.FloatRange(0), default=1_800.0, show_default=True, metavar="SECONDS",
    help="How long processes are kept warm for the next sweep, about 1.5 GB on 2 CPUs; 0: not at all.",
)  # fmt: skip
@click.option("--drain", "drain_s", type=click.FloatRange(0), default=60.0, show_default=True,
              help="Seconds that sweeps may take to save when the service ends.")  # fmt: skip
@click.option("--webhook", "webhooks", multiple=True, metavar="URL", help="Told what happens. May be repeated.")
@click.option(
    "--webhook-secret", metavar="SECRET", envvar="TUNE_JOBS_WEBHOOK_SECRET", show_envvar=True,
    help="What messages to webhooks are signed with (Standard Webhooks); better set by the variable.",
)  # fmt: skip
@click.option(
    "--run-command", metavar="COMMAND",
    help="Run when something happens, without a shell, with the message as its input; it has a minute.",
)  # fmt: skip
@click.option("--stuck", "stuck_s", type=click.FloatRange(1), default=900.0, show_default=True, metavar="SECONDS",
              help="A running sweep that takes no env step for so long is told to be stuck.")  # fmt: skip
@click.option("--public-name", "public_names", multiple=True, metavar="NAME[:PORT]",
              help="A name that the service is asked for by, besides this machine's own. May be repeated.")  # fmt: skip
@click.option("--require-token", is_flag=True, help="Let nobody in without a token, on this machine neither.")
@click.option("--behind-proxy", is_flag=False, flag_value="loopback", metavar="[ADDRESS]",
              help="Believe X-Forwarded-For and -Proto of a proxy on this machine, or at ADDRESS.")  # fmt: skip
@click.option("--tls-certificate", type=click.Path(path_type=Path), metavar="FILE", help="Certificate chain, PEM.")
@click.option("--tls-key", type=click.Path(path_type=Path), metavar="FILE", help="The certificate's key, PEM.")
@click.option("--log-format", type=click.Choice(("text", "json")), default="text", show_default=True,
              help="Of the log on standard error; json: one object a line, requests too.")  # fmt: skip
@click.option("--keep-audit", "keep_audit_days", type=click.FloatRange(0, min_open=True), default=365.0,
              show_default=True, metavar="DAYS", help="How long the audit log keeps an entry.")  # fmt: skip
@storage_option
@json_option
def serve(
    *,
    host: str,
    port: int,
    address: str | None,
    wait_for_nodes: float,
    database: str | None,
    folder: Path | None,
    envs: tuple[str, ...],
    modules: tuple[str, ...],
    spare_idle_s: float,
    drain_s: float,
    webhooks: tuple[str, ...],
    webhook_secret: str | None,
    run_command: str | None,
    stuck_s: float,
    public_names: tuple[str, ...],
    require_token: bool,
    behind_proxy: str | None,
    tls_certificate: Path | None,
    tls_key: Path | None,
    log_format: LogFormat,
    keep_audit_days: float,
    storage: str | None,
    as_json: bool,
) -> None:
    """Run the service: a queue of sweeps, a page that shows them live, and REST over the same sweep folder.

    On 127.0.0.1 it needs no token; anywhere else it does: `tune-jobs token make`.
    """
    here_only()
    # Before anything begins a thread.
    leave_first_place()
    from tune_jobs.service import logs
    from tune_jobs.service.config import ServiceConfig
    from tune_jobs.service.serve import serve as run
    from tune_jobs.sweeps.storage import absolute_folder, storage_place

    config = ServiceConfig(
        storage=storage_place(storage), host=host, port=port, address=address, database=database,
        modules=modules, envs=envs, spare_idle_s=spare_idle_s, drain_s=drain_s,
        webhooks=webhooks, webhook_secret=webhook_secret, stuck_s=stuck_s,
        command=_split(run_command or ""),
        public_names=public_names, require_token=require_token, behind_proxy=behind_proxy,
        tls_certificate=tls_certificate, tls_key=tls_key, log_format=log_format, keep_audit_days=keep_audit_days,
        own_folder=absolute_folder(folder), wait_for_nodes=wait_for_nodes,
    )  # fmt: skip
    logs.configure(log_format, secrets=config.secrets)

    def say(url: str) -> None:
        # One line, as whoever reads it waits for its end.
        told = json.dumps({"url": url, "storage": config.place})
        click.echo(told if as_json else f"serving {config.place} at {url}")

    run(config, say)


def _split(command: str) -> tuple[str, ...]:
    try:
        return tuple(shlex.split(command))
    except ValueError as error:
        # Without the command, whose arguments may be secrets.
        raise SpecError(
            f"--run-command can't be split into a command and its arguments: {error}.",
            "Close each quotation mark, and write one that is meant, or a backslash, with a backslash before it.",
        ) from error

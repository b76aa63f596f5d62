"""Where a command is done: on this machine, or by the service that --server or TUNE_JOBS_SERVER names.

Commands take the verbs of `verbs()`, which are those of `tune_jobs.sweeps.verbs` or, of a service, do and return the
same: what is printed is the same code.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource

from policies.errors import SpecError

if TYPE_CHECKING:
    from tune_jobs.client import Client

_META = "tune_jobs.server"
_TOKEN = "TUNE_JOBS_TOKEN"  # noqa: S105 (the name of a variable)
_Command = TypeVar("_Command", bound=Callable[..., Any])

THERE = (
    "launch", "list", "status", "trials", "stop", "resume", "extend", "inject", "replicate", "best", "report", "video",
    "importance", "compare", "export",
)  # fmt: skip
"""The commands that a service does."""
_ONLY_HERE = {
    "storage": ("--storage", "it names a folder of this machine, and the service has its own"),
    "detach": ("--detach", "a service runs sweeps without this terminal anyway"),
    "address": ("--address", "the service runs sweeps where its operator has said"),
    "finish": ("--finish or --no-finish", "the service always makes what follows the trials"),
    "allow_module": ("--allow-module", "its operator says which modules sweeps may name (`serve --allow-module`)"),
    "html": ("--html", "its page is made on the machine of the sweeps' folder"),
    "num_episodes": ("--num-episodes", "the policy was confirmed there when the sweep ended"),
    "seed": ("--seed", "a service has the films that were made when the sweep ended"),
    "env_id": ("--env", "a service has films of a sweep's best policy in its own environment"),
    "action": ("--action", "a service has films of a sweep's best policy"),
}
"""Options that mean nothing to a service, and why."""


@dataclass(frozen=True)
class Server:
    """The service that commands are done by.

    Args:
        url: Its address, as it was given.
        token_file: A file with a token; None: the environment has one, or none is needed.
        ca_file: Certificates of the authorities to trust; None: this machine's.
        given: The options by which that was said, as a shell takes them; the environment says the others.
    """

    url: str
    token_file: str | None
    ca_file: str | None
    given: str

    @property
    def program(self) -> str:
        """How a command for the same service begins."""
        return f"tune-jobs {self.given}".rstrip()

    def client(self, *, timeout_s: float = 60.0) -> Client:
        """Return a client of it.

        Args:
            timeout_s: How long an answer may take to begin, and to go on.

        Raises:
            SpecError: The address, the token or the certificates are none.
        """
        from tune_jobs.client import Client

        token = None if self.token_file else os.environ.get(_TOKEN) or None
        return Client(self.url, token, token_file=self.token_file, ca_file=self.ca_file, timeout_s=timeout_s)


def server_options(command: _Command) -> _Command:
    """Add the options that name a service."""
    for option in (
        click.option("--ca-file", metavar="FILE", envvar="TUNE_JOBS_CA_FILE", show_envvar=True,
                     help="Certificates, PEM, to trust in the service's place of this machine's."),
        click.option("--token-file", metavar="FILE", envvar="TUNE_JOBS_TOKEN_FILE", show_envvar=True,
                     help="A file with a token for the service.  [default: $TUNE_JOBS_TOKEN]"),
        click.option("--server", metavar="URL", envvar="TUNE_JOBS_SERVER", show_envvar=True,
                     help="Have it done by the service at URL (`tune-jobs serve`), not on this machine."),
    ):  # fmt: skip
        command = option(command)
    return command


def remember_server(ctx: click.Context, server: str | None, token_file: str | None, ca_file: str | None) -> None:
    """Keep what the options of a service say, for the commands."""
    if not server:
        return
    options = {"server": server, "token_file": token_file, "ca_file": ca_file}
    given = [
        f"--{name.replace('_', '-')} {shlex.quote(value)}"
        for name, value in options.items()
        if value and ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE
    ]
    ctx.meta[_META] = Server(server, token_file or None, ca_file or None, " ".join(given))


def server_to_complete_from(ctx: click.Context) -> Server | None:
    """Return the service that the words name which stand before the one to complete, or the environment; None: none.

    Nothing was remembered then, as no command runs.
    """
    params = ctx.find_root().params
    if not params.get("server"):
        return None
    return Server(params["server"], params.get("token_file") or None, params.get("ca_file") or None, "")


def server_of() -> Server | None:
    """Return the service that the running command is done by; None: it is done on this machine."""
    found: Server | None = click.get_current_context().meta.get(_META)
    return found


def program() -> str:
    """Return how a command begins that is to be done where the running one is."""
    server = server_of()
    return "tune-jobs" if server is None else server.program


def verbs() -> Any:
    """Return what does the running command: the functions of `tune_jobs.sweeps.verbs`, or the same of a service.

    Raises:
        SpecError: A service is named that can't be one, or an option that means nothing to a service is given.
    """
    server = server_of()
    if server is None:
        from tune_jobs.sweeps import verbs as here

        return here
    refuse_options()
    from tune_jobs.cli.remote import RemoteVerbs

    return RemoteVerbs(server.client())


def refuse_options() -> None:
    """Refuse those options of the running command that mean nothing to a service.

    Raises:
        SpecError: One is given.
    """
    ctx = click.get_current_context()
    for name, (option, why) in _ONLY_HERE.items():
        if name in {item.name for item in ctx.command.params} and (
            ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE
        ):
            raise SpecError(f"{option} goes with no service: {why}.", f"Leave it out{_or_here()}.")


def here_only() -> None:
    """Refuse the running command where a service is named.

    Raises:
        SpecError: One is.
    """
    if server_of() is None:
        return
    ctx = click.get_current_context()
    path = ctx.command_path.split(" ", 1)[-1]
    raise SpecError(
        f"`tune-jobs {path}` is not done by a service.",
        f"A service does {', '.join(THERE[:-1])} and {THERE[-1]}{_or_here()}.",
    )


def _or_here() -> str:
    server = server_of()
    is_option = server is not None and "--server" in server.given
    return f"; to do it on this machine, leave out {'--server' if is_option else 'TUNE_JOBS_SERVER'}"

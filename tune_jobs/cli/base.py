"""What all commands share: options, errors as messages with exit codes, a clean standard output."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, TypeVar

import click

from policies.errors import CannotRunError, TuneJobsError, said_by
from tune_jobs.cli.completion import complete_folders, complete_sources, complete_sweeps
from tune_jobs.process import own_files
from tune_jobs.process.interruption import EXIT_CODE as INTERRUPTED

if TYPE_CHECKING:
    from tune_jobs.sweeps.outcome import SweepResult

_CANNOT_PRINT = CannotRunError.exit_code
_NOBODY_READS = (errno.EPIPE, errno.EIO)
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_UNCHANGED = {
    "launch": "No trial had begun, and nothing was kept.",
    "resume": "No trial had begun, and nothing was changed: `tune-jobs resume SWEEP` continues it.",
    "replicate": "No trial had begun, and nothing was changed.",
    "reproduce": "Nothing was changed.",
    "extend": "No trial had begun, and nothing was changed: `tune-jobs extend SWEEP` adds to it.",
    "inject": "No trial had begun, and nothing was changed.",
}
_GOES_ON = "What is done is kept; `tune-jobs resume SWEEP` continues it."
_JSON, _JSON_NAMED, DEBUG = "tune_jobs.json", "tune_jobs.json_named", "tune_jobs.debug"
_Command = TypeVar("_Command", bound=Callable[..., Any])


class CommandGroup(click.Group):
    """A group whose commands end with a clear message and the right exit code, never with a traceback."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the words before the command, and note whether --json is among all of them."""
        ctx.meta[_JSON_NAMED] = "--json" in itertools.takewhile(lambda word: word != "--", args)
        try:
            return super().parse_args(ctx, args)
        except click.UsageError as error:
            _print_json_of_click(ctx, error)
            raise

    def invoke(self, ctx: click.Context) -> Any:
        """Run the chosen command; docs/design.md lists the exit codes."""
        try:
            return super().invoke(ctx)
        except (click.exceptions.Exit, click.Abort, BrokenPipeError):
            raise
        except click.ClickException as error:
            told = self._placed(error, ctx.invoked_subcommand)
            _print_json_of_click(ctx, told)
            raise told from None
        except KeyboardInterrupt as interruption:
            hint = _hint_after(interruption, ctx.invoked_subcommand or "")
            with losing_what_nobody_reads(True):  # noqa: FBT003
                _print_error(ctx, "Interrupted.", hint, INTERRUPTED)
            ctx.exit(INTERRUPTED)
        except TuneJobsError as error:
            if ctx.meta.get(DEBUG):
                traceback.print_exc()
            _print_error(ctx, error.message, error.hint, error.exit_code)
            ctx.exit(error.exit_code)
        except Exception as error:  # noqa: BLE001 - the last line of defence: no traceback on a user's terminal
            # An error of a file that we write would be a CannotRunError with the file's name.
            if isinstance(error, OSError) and error.errno in _FULL and error.filename is None:
                _write_nowhere(1)
                said = f"The output of this command cannot be written: {error.strerror}."
                _print_error(ctx, said, "Free space on its disk, or send the output elsewhere.", _CANNOT_PRINT)
                ctx.exit(_CANNOT_PRINT)
            message = f"Unexpected {type(error).__name__}: {said_by(error)}"
            _print_error(ctx, message, _hint_on_unexpected(ctx), TuneJobsError.exit_code)
            ctx.exit(TuneJobsError.exit_code)

    def _placed(self, error: click.ClickException, command: str | None) -> click.ClickException:
        """Return the error, or if an option of all commands stands behind one, another that says where it goes."""
        if isinstance(error, click.NoSuchOption) and any(error.option_name in own.opts for own in self.params):
            name = error.option_name
            return click.UsageError(f"{name} goes before the command: tune-jobs {name} ... {command}", error.ctx)
        return error


def _hint_after(interruption: KeyboardInterrupt, command: str) -> str:
    from tune_jobs.sweeps.interrupted import SweepInterrupted

    # Of a repetition nothing is kept that could be resumed.
    if isinstance(interruption, SweepInterrupted) or command == "reproduce":
        return _UNCHANGED[command]
    return _GOES_ON if command in _UNCHANGED else ""


def _hint_on_unexpected(ctx: click.Context) -> str:
    command = ctx.invoked_subcommand or ""
    # What is loaded and what is imported after an upgrade need not fit.
    why = "This is a bug in tune-jobs."
    if is_changed := own_files.were_changed():
        go_on = _GOES_ON if command in _UNCHANGED and command != "reproduce" else "Run the command again."
        why = f"Files of tune-jobs were changed while this ran, as by an upgrade. {go_on}"
    if ctx.meta.get(DEBUG):
        traceback.print_exc()
        return why if is_changed else ""
    return f"{why} The traceback is {_keep_traceback()}"


def _print_error(ctx: click.Context, message: str, hint: str, exit_code: int) -> None:
    click.echo(f"error: {message}" + (f"\n{hint}" if hint else ""), err=True)
    if ctx.meta.get(_JSON):
        _print_json_error(message, hint, exit_code)


def _print_json_of_click(ctx: click.Context, error: click.ClickException) -> None:
    # Of words that can't be parsed, an option may be unread, or another have taken it as its value.
    if ctx.meta.get(_JSON) or (isinstance(error, click.UsageError) and ctx.meta[_JSON_NAMED]):
        _print_json_error(error.format_message(), "", error.exit_code)


def _print_json_error(message: str, hint: str, exit_code: int) -> None:
    from tune_jobs.cli.output import print_json

    print_json({"error": message, "hint": hint, "exit_code": exit_code})


def _keep_traceback() -> str:
    """Write the traceback to a temporary file, or print it where none can be written; return where it is."""
    said = traceback.format_exc()
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="tune-jobs-error-", suffix=".txt", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:
            file.write(said)
    except OSError as error:
        click.echo(said, err=True)
        return f"above, as no temporary file can be written: {error.strerror}."
    return f"in {file.name}; --debug prints it."


def _remember_json(ctx: click.Context, _: click.Parameter, value: bool) -> bool:  # noqa: FBT001 - click's signature
    ctx.meta[_JSON] = value
    return value


def print_version(ctx: click.Context, _: click.Parameter, value: bool) -> None:  # noqa: FBT001 - click's signature
    """Print the version and exit; the callback of --version."""
    if not value or ctx.resilient_parsing:
        return
    from importlib import metadata

    try:
        version = metadata.version("tune-jobs")
    except metadata.PackageNotFoundError:
        version = "(not installed)"
    click.echo(f"tune-jobs {version}")
    ctx.exit()


json_option = click.option(
    "--json", "as_json", is_flag=True, callback=_remember_json, is_eager=True,
    help="Print one JSON document on standard output.",
)  # fmt: skip
storage_option = click.option(
    "--storage", metavar="PLACE", shell_complete=complete_folders,
    help="Folder or URL where sweeps are kept.  [default: $TUNE_JOBS_STORAGE or ./sweeps]",
)  # fmt: skip
sweep_argument = click.argument("sweep", shell_complete=complete_sweeps)
sweeps_argument = click.argument("sweeps", nargs=-1, required=True, shell_complete=complete_sweeps)
sources_argument = click.argument("sources", nargs=-1, required=True, shell_complete=complete_sources)
source_argument = click.argument("source", shell_complete=complete_sources)
num_episodes_option = click.option(
    "--num-episodes", type=click.IntRange(1, 2**18), default=100, show_default=True, help="Greedy episodes."
)
set_option = click.option(
    "--set", "overrides", multiple=True, metavar="A.B=VALUE",
    help="Override one field of the sweep file; VALUE is YAML, empty takes the field out. May be repeated.",
)  # fmt: skip


def _allow(ctx: click.Context, _: click.Parameter, names: tuple[str, ...]) -> None:
    if ctx.resilient_parsing:
        return  # a shell completes the line
    from policies.envs.modules import allow_modules

    allow_modules(names)


allow_module_option = click.option(
    "--allow-module", multiple=True, metavar="NAME", callback=_allow, expose_value=False,
    help="Let env ids and rl_module name this Python module, which runs its code. May be repeated.",
)  # fmt: skip
env_option = click.option(
    "--env", "env_id", metavar="ID", help="Environment; needed for a baseline, else the policy's own."
)


def _read_action(_: click.Context, __: click.Parameter, text: str | None) -> int | tuple[float, ...] | None:
    """Read a whole number, or numbers with commas between them, which may be in brackets."""
    if text is None:
        return None
    try:
        if not text.lstrip().startswith("[") and "," not in text and "." not in text:
            return int(text)
        return tuple(float(part) for part in text.strip().strip("[]").split(","))
    except ValueError as error:
        raise click.BadParameter(f"{text!r} is neither a whole number nor a list such as [0.5,-1].") from error


action_option = click.option(
    "--action", metavar="VALUE", callback=_read_action,
    help="The action of 'constant': a number, or a list such as [0.5,-1].  [default: 0]",
)  # fmt: skip


progress_option = click.option(
    "--progress", type=click.Choice(["auto", "none"]), default="auto", help="Show how far it is, or nothing."
)


def run_options(command: _Command) -> _Command:
    """Add the options of the commands that run trials."""
    for option in (
        click.option("--finish/--no-finish", default=True, help="Afterwards: confirm, best, evaluate, video, report."),
        click.option("--progress", type=click.Choice(["auto", "none"]), default="auto", help="Live table or nothing."),
        click.option("--detach", is_flag=True, help="Let the cluster at http://... drive it, and leave it to that."),
        click.option(
            "--address",
            metavar="ADDRESS",
            help="Ray cluster: auto, HOST:PORT, ray://... or http://... (as a job); without it, this machine.",
        ),
        click.option(
            "--wait-for-nodes",
            type=click.FloatRange(0, 10**9),
            default=0.0,
            metavar="SECONDS",
            help="With --address, or a service on a cluster: how long to wait for nodes that can hold one trial.  "
            "[default: 0, or as the service's operator said]",
        ),
        allow_module_option,
        storage_option,
        json_option,
    ):
        command = option(command)
    return command


@contextlib.contextmanager
def stdout_for(*, as_json: bool) -> Iterator[None]:
    """With --json, let only the JSON document reach standard output, whatever libraries print."""
    with contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext():
        yield


def result_of(call: Callable[..., SweepResult], *args: Any, **kwargs: Any) -> SweepResult:
    """Return the result of a launch, resume, extend or inject, also if a signal ended it.

    Raises:
        KeyboardInterrupt: A signal ended it before the sweep had begun.
    """
    from tune_jobs.sweeps.interrupted import SweepInterrupted

    try:
        return call(*args, **kwargs)
    except SweepInterrupted as interruption:
        if interruption.result is None:
            raise
        return interruption.result


@contextlib.contextmanager
def losing_what_nobody_reads(interrupted: bool) -> Iterator[None]:  # noqa: FBT001
    """Ignore errors of printing in the block if the reader of a pipe or the terminal is gone, or on an interrupt.

    A sweep that has run does not count as failed because of that. The other stream is printed to as before.
    """
    try:
        yield
        sys.stdout.flush()
        sys.stderr.flush()
    except OSError as error:
        if not interrupted and error.errno not in _NOBODY_READS:
            raise
        for number, stream in ((1, sys.stdout), (2, sys.stderr)):
            try:
                stream.flush()
            except OSError:
                _write_nowhere(number)


def say_left(message: str, hint: str, *, as_json: bool) -> None:
    """Say that an interrupt has ended a command, and what to do now, on each stream that somebody reads."""
    with losing_what_nobody_reads(True):  # noqa: FBT003
        click.echo(f"{message} {hint}", err=True)
    if as_json:
        with losing_what_nobody_reads(True):  # noqa: FBT003
            _print_json_error(message, hint, INTERRUPTED)


def _write_nowhere(number: int) -> None:
    """Send a descriptor to nowhere from now on, as Python flushes standard output and error once more at its end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, number)
    os.close(nowhere)

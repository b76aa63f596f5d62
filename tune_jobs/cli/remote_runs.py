"""What runs trials, done by a service: asked for, followed line by line to its end, and its result."""

from __future__ import annotations

import contextlib
import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

import click

from analysis.wording import PLAIN_NONE, counted, duration, return_text, short_text
from policies.errors import NotFoundError, SpecError, TuneJobsError, fit
from tune_jobs.cli.base import losing_what_nobody_reads, say_left, stdout_for
from tune_jobs.cli.going_on import retry_notes
from tune_jobs.cli.remote import told_here
from tune_jobs.cli.server import Server
from tune_jobs.client.answers import Job, Summary
from tune_jobs.client.problems import TooManyError
from tune_jobs.process.interruption import EXIT_CODE as INTERRUPTED
from tune_jobs.service.jobs import NO_BEST

if TYPE_CHECKING:
    from tune_jobs.client import Client

_LINE_INTERVAL_S = 10.0
"""As of a sweep that runs here without a terminal."""
_MOST_POINT = 60
_STATES = {"creating": "is being written", "waiting": "waits for its turn", "running": "runs", "ended": "has ended"}
_ARTIFACTS = {
    "policy": "policy", "before_mp4": "films/before_mp4", "after_mp4": "films/after_mp4",
    "after_gif": "films/after_gif", "before_after_mp4": "films/before_after_mp4", "report": "report/",
}  # fmt: skip
"""What a result names, and where it is had: it is there if a file's path begins so."""


def run_there(
    server: Server, verb: str, arguments: Sequence[Any], *, as_json: bool, progress: str = "auto", **options: Any
) -> int:
    """Have a service do it, follow it until its end, and print the result.

    Args:
        server: The service.
        verb: launch, resume, extend, inject or replicate.
        arguments: Those of the verb that have no names.
        as_json: Whether to print one JSON document.
        progress: `none`: no lines while it runs.
        options: Further arguments of the verb.

    Returns:
        The exit code.

    Raises:
        TuneJobsError: The service refuses, or it failed there.
    """

    def say(line: str) -> None:
        if progress != "none":
            with losing_what_nobody_reads(False):  # noqa: FBT003
                click.echo(fit(line), err=True)

    with server.client() as client, stdout_for(as_json=as_json):
        found = _done(server, client, verb, arguments, options, say)
    if isinstance(found, _Left):
        say_left(*found, as_json=as_json)
        return INTERRUPTED
    return _show(found, server, as_json=as_json)


class _Left(NamedTuple):
    """Why a sweep is no longer followed, and what to do now."""

    message: str
    hint: str


def _done(  # noqa: PLR0917 (all of them are one request)
    server: Server,
    client: Client,
    verb: str,
    arguments: Sequence[Any],
    options: dict[str, Any],
    say: Callable[[str], None],
) -> dict[str, Any] | _Left:
    try:
        job = _begun(client, verb, arguments, options)
    except KeyboardInterrupt:
        return _Left("Interrupted while it was being asked for.", f"See whether it is there: {server.program} list")
    name = shlex.quote(job.sweep)
    status, stop = f"{server.program} status {name}", f"{server.program} stop {name}"
    try:
        with _telling(
            f"{job.sweep} was submitted to {client.url}, and is no longer followed",
            f"It goes on there: see {status}, and stop it with: {stop}",
        ):
            job = _followed(client, job, say)
    except KeyboardInterrupt:
        message = f"No longer followed; {job.sweep} goes on at {client.url}."
        return _Left(message, f"Stop it with: {stop}")
    if job.outcome == "failed":
        raise TuneJobsError(
            f"Sweep {job.sweep} failed at {client.url}: {job.message or 'nothing is known of why'}",
            f"Continue with: {server.program} resume {name}",
        )
    ended, look = f"Sweep {job.sweep} has ended at {client.url}: {job.outcome}", f"See what came of it: {status}"
    try:
        with _telling(f"{ended}. Its result can't be had", look):
            return _result(client, job)
    except KeyboardInterrupt:
        return _Left(f"{ended}.", look)


@contextlib.contextmanager
def _telling(what: str, hint: str) -> Iterator[None]:
    """Say what was done where a service does not answer any more: whoever asks for it again gets it twice."""
    try:
        yield
    except NotFoundError:
        # It was deleted meanwhile.
        raise
    except TuneJobsError as error:
        raise error.again(f"{what}: {error.message}", hint) from error


def _begun(client: Client, verb: str, arguments: Sequence[Any], options: dict[str, Any]) -> Job:
    name = arguments[0]
    # 0 is what is there where nothing was given: then it is as the service's operator has said.
    wait: dict[str, Any] = {"wait_for_nodes": options.get("wait_for_nodes") or None}
    match verb:
        case "launch":
            try:
                return client.submit(name, overrides=options["overrides"], name=options["name"], **wait).job
            except SpecError as error:
                raise told_here(error, name, options["overrides"]) from error
        case "extend":
            return client.extend(name, arguments[1], **wait)
        case "inject":
            return client.inject(name, arguments[1], **wait)
        case "replicate":
            return client.replicate(name, top=options["top"], seeds=options["seeds"], **wait)
        case _:
            # As here: without a failed trial there is nothing to retry, and whatever else is missing is run.
            has_failed = options["retry_failed"] and client.status(name).counts.get("failed")
            return client.retry(name, **wait) if has_failed else client.resume(name, **wait)


def _followed(client: Client, job: Job, say: Callable[[str], None]) -> Job:
    """Say how far a job is until it has ended, and return it."""
    began = time.monotonic()
    try:
        job = _watched(client, job, say, began)
    except TooManyError:
        # As many watch as may. It is asked now and then whether it has ended, as all may.
        say(f"{job.sweep}: too many watch sweeps there; its end is waited for")
        client.wait(job.sweep, job=job)
        job = client.job(job.id)
    if job.outcome in ("completed", "stopped"):
        say(_line(client.sweep(job.sweep), time.monotonic() - began))
    return job


def _watched(client: Client, job: Job, say: Callable[[str], None], began: float) -> Job:
    """Say how far a job is, as its events tell, and return it when it has ended."""
    told_at = began
    state, seen = job.state, None
    say(f"{job.sweep}: {_STATES.get(state, state)}")
    for event, now in client.job_events(job):
        job = now
        if event.kind == "status":
            seen = Summary.model_validate(event.data)
        if job.state != state:
            state = job.state
            say(f"{job.sweep}: {_STATES.get(state, state)}")
        elif state == "running" and seen is not None and time.monotonic() - told_at >= _LINE_INTERVAL_S:
            told_at = time.monotonic()
            say(_line(seen, told_at - began))
    return job


def _line(seen: Summary, elapsed_s: float) -> str:
    """Describe the state of a sweep in one line, as one that runs here is."""
    words = [f"{seen.name}: {duration(elapsed_s, tenths=False)}"]
    steps = counted(seen.num_env_steps, "env step")
    words.append(f"{100 * seen.num_env_steps // seen.max_env_steps} %, {steps}" if seen.max_env_steps else steps)
    words.append(", ".join(f"{count} {status}" for status, count in sorted(seen.counts.items()) if count))
    if seen.best is not None:
        point = ", ".join(f"{name} {short_text(value)}" for name, value in seen.best["point"].items())
        point = point if len(point) <= _MOST_POINT else f"{point[:_MOST_POINT]} ..."
        score, trial = return_text(seen.best["score"]), seen.best["trial_id"]
        words.append(f"best {score} ({trial}: {point or 'no searched values'})")
    if seen.waiting is not None:
        words.append(f"waits for {seen.waiting.told(time.time())}")
    elif seen.time_left_s:
        words.append(f"about {duration(seen.time_left_s, tenths=False, none=PLAIN_NONE)} left")
    return "; ".join(words)


def _result(client: Client, job: Job) -> dict[str, Any]:
    """Return what a launch on this machine returns, its paths as addresses."""
    name, is_whole = job.sweep, job.outcome == "completed"
    best, trials, unchosen = None, client.records(name), None
    if is_whole:
        try:
            best = client.best(name)
        except NotFoundError as error:
            unchosen = str(error)
    notes, why = _said(job, unchosen) if is_whole else ([], None)
    files = {file.path for file in client.files(name)} if is_whole else set()
    at = f"{client.url}/api/v1/sweeps/{quote(name)}"
    has_failed = any(trial.status == "failed" for trial in trials)
    finish_failed = is_whole and (best is None or bool(job.finish_failed))
    return {
        "folder": f"{client.url}/#/sweeps/{quote(name)}",
        "sweep": client.status(name).sweep,
        "trials": trials,
        "best": best,
        "why_no_best": why,
        "artifacts": {
            what: f"{at}/{path}" for what, path in _ARTIFACTS.items() if any(file.startswith(path) for file in files)
        },
        "interrupted": not is_whole,
        "notes": notes,
        "finish_failed": finish_failed,
        "exit_code": INTERRUPTED if not is_whole else 3 if has_failed or finish_failed else 0,
    }


def _said(job: Job, unchosen: str | None) -> tuple[list[str], str | None]:
    """Return the notes of a job that completed, and why its sweep has no best policy; None: it has one.

    Args:
        job: The job.
        unchosen: What the service answers where it is asked for the best policy, and there is none; None: there is.
    """
    told, is_said, why = (job.message or "").partition(NO_BEST)
    notes = [told.strip()] if told.strip() else []
    if unchosen is None:
        return notes, None
    # Of an older service, the message is all that it says of it.
    return (notes, why) if is_said else ([], told or unchosen)


def _show(result: dict[str, Any], server: Server, *, as_json: bool) -> int:
    from tune_jobs.cli import output

    def resume() -> str:
        return f"{server.program} resume {shlex.quote(result['sweep'].name)}"

    with losing_what_nobody_reads(result["interrupted"]):
        if as_json:
            output.print_json(result)
        else:
            output.print_outcome(
                result["sweep"], result["trials"], best=result["best"], why_no_best=result["why_no_best"],
                paths={"sweep": result["folder"], **result["artifacts"]},
                notes=[*result["notes"], *retry_notes(result["trials"], resume, interrupted=result["interrupted"])],
            )  # fmt: skip
    if result["interrupted"]:
        with losing_what_nobody_reads(True):  # noqa: FBT003
            output.say_interrupted(result["sweep"], resume())
    code: int = result["exit_code"]
    return code

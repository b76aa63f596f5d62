"""Have a Ray cluster run a sweep's driver as a job, so that nothing of this machine is needed once it has begun."""

from __future__ import annotations

import contextlib
import os
import secrets
import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from analysis.records import JobRecord
from policies.envs.modules import allowed_again, allowed_modules
from policies.errors import CannotRunError, NotFoundError, SpecError, TuneJobsError, fit
from policies.guard.guard import guarding
from tune_jobs.plan.user_code import Source, load_source, modules_of
from tune_jobs.process.interruption import EXIT_CODE as INTERRUPTED
from tune_jobs.ray_tune import known_clusters
from tune_jobs.ray_tune.jobs import Job, JobsApi, JobState, check_jobs_address, token_of
from tune_jobs.store.command_names import name_in_commands
from tune_jobs.store.contract import Sweep
from tune_jobs.store.opening import open_sweep
from tune_jobs.sweeps.create import remove_unless_it_waited, removed_if_not_begun, write_created
from tune_jobs.sweeps.own_job import environment_of, job_of, own_job_address, version_here
from tune_jobs.sweeps.storage import stem_of, storage_place
from tune_jobs.sweeps.travel import folder_to_send, packed

_BEGIN_S = 60.0
"""How long is waited for a job to begin; one that waits for nodes may take longer, and goes on without this process."""
_POLL_S = 0.5
_ASK_S = 2.0
_HAS_RUN = (0, 3, INTERRUPTED)
"""Exit codes of a driver that ran the sweep; Ray calls a job that ends with 3 or 130 failed, too."""
_MAX_SAID = 1_000


@dataclass(frozen=True)
class DetachedSweep:
    """A sweep that a job was asked to run."""

    name: str
    place: str
    """Where it is, for this machine and for the cluster's nodes."""
    job: JobRecord
    is_new: bool
    """Whether it was written for this job; one that was there before is not removed if the job fails."""


@allowed_again()
@guarding(start=True)
def launch_detached(
    source: Source,
    *,
    overrides: Sequence[str] = (),
    name: str | None = None,
    storage: str | Path | None = None,
    address: str | None,
    finish: bool = True,
    wait_for_nodes: float = 0.0,
) -> DetachedSweep:
    """Write a new sweep and have a cluster run it; `wait_until_begun` tells whether it does.

    Args:
        source: The same as for `tune_jobs.launch`.
        overrides: The same as for `tune_jobs.launch`.
        name: The same as for `tune_jobs.launch`.
        storage: A folder that the cluster's nodes have under the same path.
        address: The Jobs API of the cluster, such as `http://head:8265`.
        finish: The same as for `tune_jobs.launch`.
        wait_for_nodes: The same as for `tune_jobs.launch`; the job waits, and this process need not.

    Raises:
        SpecError: The sweep or the address is wrong, or its name is taken. Nothing was written or sent.
        CannotRunError: The cluster can't be reached or refuses the job, or the storage can't be written. Nothing stays.
    """
    address = check_jobs_address(address)
    spec = load_source(source, overrides)
    chosen = name if name is not None else spec.name
    content = _modules_of_sweep(modules_of(spec), source)
    with JobsApi(address) as api:
        api.ray_version()
        created = write_created(spec, chosen, stem_of(source), storage_place(storage), "auto")
        with removed_if_not_begun(created):
            store = open_sweep(created.place)
            job = _new_job(store, address)
            with store.lock():
                store.write_record(store.read_record().model_copy(update={"job": job}))
            _submit(api, store, job, ["resume", *_waiting(wait_for_nodes)], content, finish=finish)
    return DetachedSweep(store.name, created.place, job, is_new=True)


def go_on_detached(
    verb: str,
    sweep: str | Path,
    options: Sequence[str] = (),
    *,
    storage: str | Path | None = None,
    address: str | None,
    finish: bool = True,
    wait_for_nodes: float = 0.0,
) -> DetachedSweep:
    """Have a cluster go on with a sweep.

    Args:
        verb: The command that its job does: resume, extend, inject or replicate.
        sweep: Name or folder.
        options: What the command takes besides the sweep and what all of them take.
        storage: The same as for `launch_detached`.
        address: The same as for `launch_detached`.
        finish: The same as for `launch_detached`.
        wait_for_nodes: The same as for `launch_detached`.

    Raises:
        NotFoundError: There is no such sweep.
        SpecError: The address is wrong.
        CannotRunError: A process or a job runs the sweep, or the cluster can't be reached or refuses the job.
    """
    from tune_jobs.sweeps.sources import find_sweep

    address = check_jobs_address(address)
    store = find_sweep(sweep, storage)
    record = store.read_record()
    named = name_in_commands(store.place)
    watch = f"Watch it with `tune-jobs attach {named}`, or end it with `tune-jobs stop {named}`."
    if store.is_driven():
        raise CannotRunError(f"Sweep {store.name} is being run by another process.", watch)
    known = job_of(record, store.place)
    before = None if known is None else job_now(known, named=(address,))
    if known is not None and before is not None and not before.has_ended:
        raise CannotRunError(f"Job {known.id} at {known.address} is about to run sweep {store.name}.", watch)
    content = _modules_of_sweep(record.allowed_modules, None)
    with JobsApi(address) as api:
        api.ray_version()
        job = _new_job(store, address)
        _submit(api, store, job, [verb, *options, *_waiting(wait_for_nodes)], content, finish=finish)
    return DetachedSweep(store.name, store.place, job, is_new=False)


def wait_until_begun(detached: DetachedSweep, *, timeout_s: float = _BEGIN_S) -> JobState:
    """Wait until a job has begun with its sweep, and return its state; PENDING if it has not begun in time.

    A new sweep whose job fails before it begins is removed, unless it waited for nodes.

    Raises:
        TuneJobsError: The job failed before it began, with the error that it ended with.
    """
    store, deadline = open_sweep(detached.place), time.monotonic() + timeout_s
    state: JobState = "PENDING"
    with JobsApi(detached.job.address, timeout_s=max(_ASK_S, min(timeout_s, 10.0))) as api:
        while True:
            found = None
            # An answer that is lost says nothing of the job.
            with contextlib.suppress(CannotRunError):
                found = api.job(detached.job.id)
            state = state if found is None else found.status
            if found is not None and found.has_ended:
                if not ran(found):
                    if detached.is_new:
                        _forget(store)
                    raise failure_of(store, detached.job, found)
                return state
            record = store.read_record()
            if record.job == detached.job and record.state not in ("created", "completed") and store.is_driven():
                return "RUNNING"
            if time.monotonic() > deadline:
                return state
            time.sleep(_POLL_S)


def job_now(job: JobRecord, *, timeout_s: float = _ASK_S, named: Sequence[str] = ()) -> Job | None:
    """Return what becomes of a job; None: its cluster can't or won't be asked just now, or has forgotten it.

    Args:
        job: As a sweep's record has it.
        timeout_s: How long an answer may take.
        named: Addresses that the user has named in this call.
    """
    with contextlib.suppress(TuneJobsError), _api_of(job, named, timeout_s=timeout_s) as api:
        return api.job(job.id)
    return None


def why_not_asked(job: JobRecord, named: Sequence[str] = ()) -> CannotRunError | None:
    """Return why a job's cluster is not asked: it would be shown Ray's token, and only a record names its address."""
    with contextlib.suppress(TuneJobsError):
        address = check_jobs_address(job.address)
        if token_of(os.environ) is not None and not known_clusters.is_named(address, (*named, own_job_address())):
            return CannotRunError(
                f"Only the sweep's record names {address}, so Ray's token is not sent there, and what becomes of job "
                f"{job.id} is not known.",
                f"If that is your cluster, set RAY_API_SERVER_ADDRESS={shlex.quote(address)}.",
            )
    return None


def _api_of(job: JobRecord, named: Sequence[str] = (), **options: float) -> JobsApi:
    """Return the Jobs API that a record names; whoever wrote that may be anybody.

    Raises:
        CannotRunError: It would be shown Ray's token, and the user has not named it.
    """
    refused = why_not_asked(job, named)
    if refused is not None:
        raise refused
    return JobsApi(job.address, **options)


def ran(job: Job) -> bool:
    """Whether an ended job ran its sweep, to its end or until it was asked to stop."""
    return job.status in ("SUCCEEDED", "STOPPED") or job.driver_exit_code in _HAS_RUN[1:]


def told_of(job: Job | None) -> str:
    """Return the state of a job for a reader."""
    if job is None:
        return "not known (its cluster does not answer, refuses the token, or has forgotten it)"
    # The exit code of a sweep with failed trials is no failure of the job.
    return "ended" if job.has_ended and ran(job) else job.status.lower()


def failure_of(store: Sweep, job: JobRecord, found: Job) -> TuneJobsError:
    """Return the error that a job ended with: its own words, where it has said some."""
    said, hint = _said(found.message or "")
    kind = {2: SpecError, 4: NotFoundError}.get(found.driver_exit_code or 0, CannotRunError)
    if found.driver_exit_code == NotFoundError.exit_code:
        kind, hint = CannotRunError, "The storage folder has to be the same on this machine and on the cluster's nodes."
    elif found.driver_exit_code == 127:
        hint = "tune-jobs has to be installed on the cluster's head, and to be found on its PATH."
    return kind(
        f"Job {job.id} of sweep {store.name}, at {job.address}, failed: {said}", hint or _how_to_go_on(store, job)
    )


def cancel_waiting(store: Sweep) -> bool:
    """End the job that is to run a sweep and has not begun with it; return whether there was one.

    Raises:
        CannotRunError: Its cluster is not asked, see `why_not_asked`, or refuses to end it.
    """
    record = store.read_record()
    job = job_of(record, store.place)
    if job is None:
        return False
    refused = why_not_asked(job)
    if refused is not None:
        if record.state not in ("created", "running"):
            return False  # it has been driven, and so has the job that its record names
        raise refused
    found = job_now(job)
    if found is None or found.has_ended:
        return False
    with _api_of(job) as api:
        return api.stop(job.id)


def _how_to_go_on(store: Sweep, job: JobRecord) -> str:
    # The storage may not answer: that is not the error to be told.
    with contextlib.suppress(TuneJobsError):
        if not store.exists():
            return "Nothing was kept; launch it again."
    return f"Continue with `tune-jobs resume {name_in_commands(store.place)} --address {job.address} --detach`."


def _said(message: str) -> tuple[str, str]:
    """Return the error that the log in a job's message ends with, and its hint; else the message's own words."""
    lines = [line.rstrip() for line in message.splitlines() if line.strip()]
    for number in range(len(lines) - 1, -1, -1):
        if lines[number].startswith("error: "):
            hint = lines[number + 1] if number + 1 < len(lines) else ""
            return fit(lines[number].removeprefix("error: "), _MAX_SAID), fit(hint, _MAX_SAID)
    if not lines:
        return "Ray does not say why.", ""
    # What is said before a log, or the last line of a traceback.
    first, last = fit(lines[0].strip(), _MAX_SAID), fit(lines[-1].strip(), _MAX_SAID)
    return (first if first == last else f"{first} {last}"), ""


def _modules_of_sweep(modules: Sequence[str], source: object) -> bytes | None:
    """Return the folder that holds modules of a sweep, packed: that of its file, or the current one."""
    wanted = sorted({*modules, *allowed_modules()}) if modules else []
    folders = [Path.cwd()]
    if isinstance(source, str | Path) and Path(source).is_file():
        folders.insert(0, Path(source).absolute().parent)
    for folder in folders:
        if folder_to_send(wanted, folder) is not None:
            return packed(folder)
    return None


def _waiting(wait_for_nodes: float) -> list[str]:
    return ["--wait-for-nodes", str(wait_for_nodes)] if wait_for_nodes else []


def _new_job(store: Sweep, address: str) -> JobRecord:
    return JobRecord(id=f"{store.name}-{secrets.token_hex(4)}", address=address, place=store.place)


def _submit(
    api: JobsApi, store: Sweep, job: JobRecord, command: Sequence[str], content: bytes | None, *, finish: bool
) -> None:
    verb, *options = command
    words = ["tune-jobs", verb, store.place, *options, "--address", "auto"]
    words += [] if finish else ["--no-finish"]
    runtime_env: dict[str, object] = {"env_vars": environment_of(job)}
    if content is not None:
        runtime_env["working_dir"] = api.upload(content)
    api.submit(
        job.id, shlex.join(words), runtime_env, {"sweep": store.name, "tune_jobs_version": version_here()}
    )  # fmt: skip
    if api.shows_token:
        known_clusters.note(api.address)


def _forget(store: Sweep) -> None:
    """Remove a sweep that no job has begun with, nor waited for."""
    with contextlib.suppress(TuneJobsError), store.lock():
        remove_unless_it_waited(store)

"""The process that drives one sweep for the service.

It is started before there is a job, so that what takes seconds to import is there when one comes, and waits on a
socket. The job comes with the descriptor that holds the job's lock. From then on it needs the service no more: it has
a session of its own, writes how the job ended into the job's file, and lives on if the service is killed.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import socket
import sys
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from policies.envs.modules import allow_modules
from policies.errors import CannotRunError, TuneJobsError, fit, said_by
from tune_jobs.process import own_files
from tune_jobs.process.interruption import end_in_order
from tune_jobs.service import logs
from tune_jobs.service.job_files import Ended, Holder, JobFiles
from tune_jobs.service.jobs import NO_BEST
from tune_jobs.store.urls import name_of_place, outer_place

if TYPE_CHECKING:
    from tune_jobs.spec.sweep_spec import SweepSpec

_log = logging.getLogger(__name__)

READY = b"ready"
_END = b"\n"
"""Of a message; one without it is of a service that was killed in between, or sent none."""


def main(descriptor: int) -> None:
    """Wait for a job, and do it.

    Args:
        descriptor: This end of the socket to the service. If the other one is closed before a job comes, this ends.
    """
    # Under nohup it would be ignored; it is how the service asks for an end, and no terminal sends it here.
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    end_in_order()
    with contextlib.ExitStack() as stack:
        # Without a buffer no byte of the next message is taken: descriptors come beside the first one of theirs.
        with socket.socket(fileno=descriptor) as asked, asked.makefile("rb", buffering=0) as lines:
            asked.set_inheritable(False)
            try:
                settings = lines.readline()
                if not settings.endswith(_END):
                    return
                known = json.loads(settings)
                # Until there is a job, this is said where the service says its own.
                logs.configure(
                    known.get("log_format", "text"), process={"process": "spare"}, level=logging.WARNING, anew=True
                )
                warm_up(stack, known)
                with contextlib.suppress(OSError):
                    asked.sendall(READY)
                first, descriptors, _, _ = socket.recv_fds(asked, 1, 3)
                message = first + lines.readline()
            except (KeyboardInterrupt, ConnectionError):
                return
        if message.endswith(_END):
            _do(json.loads(message), *descriptors)


def _do(request: Mapping[str, Any], lock: int, log: int) -> None:
    # The job's lock is this process's alone: one that it starts and that outlives it must not hold it.
    os.set_inheritable(lock, False)  # noqa: FBT003 (takes no keyword)
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.close(log)
    files = JobFiles(Path(request["service"]), request["job"])
    sweep = name_of_place(request["sweep"])
    files.say_who(Holder(pid=os.getpid(), sweep=sweep))
    # The end of this log is shown to people who want to know why a job failed.
    logs.configure("text", process={"job": request["number"], "sweep": sweep}, level=logging.WARNING, anew=True)
    _log.setLevel(logging.INFO)
    _log.info("Attempt %d is run by process %d.", request["attempt"], os.getpid())
    # Who is told how to go on asks the service, which knows its sweeps by their names.
    os.environ["TUNE_JOBS_STORAGE"] = outer_place(request["sweep"])
    ended = _ended(request)
    _log.info("Attempt %d has ended: %s.", request["attempt"], ended.outcome)
    # Whatever comes now, the outcome is written.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    files.write_ended(ended)
    os.close(lock)


def warm_up(stack: contextlib.ExitStack, settings: Mapping[str, Any]) -> None:
    """Import what driving a sweep needs, and start Ray and a process for environments if that is asked for.

    Args:
        stack: Ends them when this process ends.
        settings: The modules that sweeps may name, the folder to be in, and whether they are started.
    """
    allow_modules(settings["modules"])
    if settings["modules"]:
        # A `launch` finds them in the folder that it is typed in, too. Here that is where the service was started.
        with contextlib.suppress(OSError):  # that folder is gone
            sys.path.append(os.getcwd())  # noqa: PTH109 (sys.path holds strings)
    os.chdir(settings["working_folder"])
    if not settings["warm_ray"]:
        _import_all()
        return
    from policies.guard.guard import guarding
    from tune_jobs.plan.machine import local_machine
    from tune_jobs.ray_tune.warm import warm_ray

    try:
        # The plan is made anew on the machine that runs it, and takes its environment to a process of its own.
        stack.enter_context(guarding(start=True))
        # Ray's processes take a second or two to start, in which this one would only wait. Not in a thread beside it:
        # two that import parts of Ray at once may see modules half done.
        stack.enter_context(warm_ray(local_machine(), _import_all))
    except CannotRunError as error:
        # The sweep says so, in its own words.
        _log.warning("What a sweep needs can't be started before there is one: %s", error)
    # Where Ray did not get so far.
    _import_all()


def _import_all() -> None:
    import tune_jobs.ray_tune.cluster
    import tune_jobs.ray_tune.run_trials
    import tune_jobs.sweeps.verbs  # noqa: F401


def _ended(request: Mapping[str, Any]) -> Ended:
    attempt = request["attempt"]
    try:
        result = _done(request)
    except KeyboardInterrupt:  # SweepInterrupted is one, too
        return Ended(attempt=attempt, outcome="interrupted")
    except TuneJobsError as error:
        return Ended(attempt=attempt, outcome="failed", message=str(error))
    except BaseException as error:  # noqa: BLE001 (it is told)
        traceback.print_exc()
        if own_files.were_changed():
            # What was loaded and what was imported after that need not fit: a new process goes on.
            _log.warning("Files of tune-jobs were changed while this ran, as by an upgrade: it goes on later.")
            return Ended(attempt=attempt, outcome="interrupted")
        return Ended(attempt=attempt, outcome="failed", message=f"{type(error).__name__}: {said_by(error)}")
    if result.interrupted:
        return Ended(attempt=attempt, outcome="stopped")
    failed = [trial for trial in result.trials if trial.status == "failed"]
    told = [f"{len(failed)} of {len(result.trials)} trials failed."] if failed else []
    told += result.notes
    told += [] if result.why_no_best is None else [f"{NO_BEST}{result.why_no_best}"]
    message = fit(" ".join(told)) or None
    return Ended(attempt=attempt, outcome="completed", message=message, finish_failed=result.finish_failed)


def _done(request: Mapping[str, Any]) -> Any:
    from tune_jobs.sweeps.drive import within_cpus

    if request["address"] is not None:
        return _driven(request)
    # The others are those of other jobs, whatever this one could make of them.
    with within_cpus(max(request["num_cpus"], _spec_of(request["sweep"]).cpus_per_trial)):
        return _driven(request)


def _driven(request: Mapping[str, Any]) -> Any:
    from tune_jobs.sweeps import verbs

    place, arguments = request["sweep"], request["arguments"]
    common: dict[str, Any] = {
        "address": request["address"], "progress": "none", "wait_for_nodes": request["wait_for_nodes"],
    }  # fmt: skip
    match request["verb"]:
        case "extend":
            # The job says how many samples there are to be in all, so that an attempt that follows a killed one adds
            # none twice.
            missing = arguments["to_num_samples"] - _spec_of(place).num_samples
            if missing > 0:
                return verbs.extend(place, missing, **common)
            return verbs.resume(place, **common)
        case "inject" if not _has_point(place, arguments["point"]):
            return verbs.inject(place, arguments["point"], **common)
        case "replicate":
            # The race has the job's name, so that an attempt that follows a killed one begins no other.
            return verbs.replicate(place, top=arguments["top"], seeds=arguments["seeds"], race=request["job"], **common)
        case "retry":
            return verbs.resume(place, retry_failed=_has_to_retry(request), **common)
        case _:
            return verbs.resume(place, **common)


def _has_to_retry(request: Mapping[str, Any]) -> bool:
    """Whether there are failed trials that are to run again: not those that did so for this job, and failed again."""
    from tune_jobs.store.opening import open_sweep

    failed = [trial for trial in open_sweep(request["sweep"]).read_trials() if trial.status == "failed"]
    # An attempt lets all of them wait before it trains one, so that of those from before all are left or none.
    return any(request["attempt"] == 1 or (trial.ended_at or 0.0) < request["started_at"] for trial in failed)


def _spec_of(place: str) -> SweepSpec:
    from tune_jobs.spec.file import stored_spec
    from tune_jobs.store.opening import open_sweep

    return stored_spec(open_sweep(place).read_record())


def _has_point(place: str, point: Mapping[str, Any]) -> bool:
    """Whether an attempt before this one has added a point that somebody chose; what is missing of it is run, then."""
    from tune_jobs.store.opening import open_sweep

    return any(item.point == point for item in open_sweep(place).read_record().chosen_points)


if __name__ == "__main__":
    main(int(sys.argv[1]))

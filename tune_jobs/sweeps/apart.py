"""Run a sweep in a process of its own, for a thread of this process that waits for it.

Signals, descriptors 1 and 2, environment variables and the connection to Ray belong to a process, not to a thread. So a
thread must not change them, and a second sweep beside another one gets its own.
"""

from __future__ import annotations

import atexit
import contextlib
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any

from policies.envs.modules import allowed_modules
from policies.errors import CannotRunError
from policies.standard_streams import standard_streams
from tune_jobs.process.interruption import ASKED, main_thread_was_interrupted, num_taken
from tune_jobs.process.streams import standard_error
from tune_jobs.store.names import DRIVER_LOG
from tune_jobs.sweeps.drive import address_of_users_ray
from tune_jobs.sweeps.interrupted import SweepInterrupted
from tune_jobs.sweeps.outcome import SweepResult
from tune_jobs.sweeps.own_process import ERROR, LOG, SIGNALS, Request

_LOOK_S = 0.25
_PATIENCE_S = 10.0
# With `-P`, nothing in the working directory can hide these packages. Ctrl-C ends the child silently at first.
_BEGIN = """\
import signal
signal.signal(signal.SIGINT, signal.SIG_DFL)
import sys
sys.path.insert(0, {root!r})
import tune_jobs
del sys.path[0]
from tune_jobs.sweeps.own_process import main
main({parent}, {descriptor})
"""
_ROOT = str(Path(__file__).parents[2])

_running: dict[subprocess.Popen[bytes], threading.Event] = {}
"""The children, and whether the threads that wait for them have got their answers."""
_pid = os.getpid()


def call_apart(function: str, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> SweepResult:
    """Call a function that runs a sweep in a child process, and wait for it.

    Args:
        function: Its `module:function`; the child too runs it in its main thread.
        args: Its positional arguments.
        kwargs: Its keyword arguments.

    Returns:
        Its result.

    Raises:
        CannotRunError: The child could not be started, or ended without an answer.
        BaseException: The error that the function raised, which may be SweepInterrupted.
    """
    script = getattr(sys.modules.get("__main__"), "__file__", None)
    request = Request(
        function,
        args,
        kwargs,
        path=tuple(sys.path),
        script=sys.argv[0] if sys.argv else "",
        main_file=script,
        modules=allowed_modules(),
        ray_address=address_of_users_ray(),
    )
    process, connection = _started()
    done = _running[process] = threading.Event()
    try:
        try:
            # That the child has ended is noticed when its answer is read.
            with contextlib.suppress(OSError):
                connection.send(request)
            kind, answer = _answer(process, connection)
        except KeyboardInterrupt:
            # This happens if the main thread waits, from inside of another sweep.
            process.send_signal(ASKED)
            kind, answer = _answer(process, connection)
    finally:
        connection.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_PATIENCE_S)
        process.kill()
        process.wait()
        del _running[process]
        done.set()
    if kind == ERROR:
        raise answer
    result: SweepResult = answer
    return result


def _started() -> tuple[subprocess.Popen[bytes], Connection[Any, Any]]:
    # Imported here because it needs NumPy.
    from tune_jobs.process.state import environment

    ours, theirs = Pipe()
    number = theirs.fileno()
    code = _BEGIN.format(root=_ROOT, parent=os.getpid(), descriptor=number)
    try:
        with standard_streams():
            errors = standard_error()
            # In this process's group, so that signals of a terminal reach both.
            process = subprocess.Popen(  # noqa: S603 (this very Python)
                [sys.executable, "-P", "-c", code],
                stdin=subprocess.DEVNULL, stdout=errors, stderr=errors, env=environment(), pass_fds=[number],
            )  # fmt: skip
    except OSError as error:
        ours.close()
        raise CannotRunError(
            f"No process can be started to run the sweep in ({sys.executable}): {error}.",
            "See what limits the processes of this user, with `ulimit -u`.",
        ) from error
    finally:
        theirs.close()
    return process, ours


def _answer(process: subprocess.Popen[bytes], connection: Connection[Any, Any]) -> tuple[str, Any]:
    """Wait for the child's answer; meanwhile pass on its log records, and ask it to end on an interrupt."""
    num_before, is_asked = num_taken(), False
    while True:
        try:
            if connection.poll(_LOOK_S):
                kind, value = connection.recv()
                if kind != LOG:
                    return kind, value
                _log(value)
            elif process.poll() is not None and not connection.poll():
                return ERROR, _lost(process)
        except (EOFError, OSError):
            return ERROR, _lost(process)
        if not is_asked and (num_taken() != num_before or main_thread_was_interrupted()):
            # Not at once: a terminal's signal has reached the child by now, and this one does not count as a second.
            is_asked = True
            process.send_signal(ASKED)


@atexit.register
def _end_in_order() -> None:
    """Ask children that still run when this process ends to end too, and wait for them.

    The threads that wait for them may be daemons. And up to Python 3.12, a thread that is being joined when Ctrl-C
    comes counts as ended (an error in the fix of bpo-45274), so it is not waited for.
    """
    # A fork of this process has no such children.
    running = dict(_running) if os.getpid() == _pid else {}
    for process in running:
        process.send_signal(ASKED)
    for done in running.values():
        done.wait()


def _log(record: logging.LogRecord) -> None:
    logger = logging.getLogger(record.name)
    if logger.isEnabledFor(record.levelno):
        logger.handle(record)


def _lost(process: subprocess.Popen[bytes]) -> BaseException:
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_PATIENCE_S)
    code = process.returncode
    if code is not None and -code in SIGNALS:
        # The child handles these signals after it has begun.
        return SweepInterrupted()
    how = "closed its connection" if code is None else f"ended with exit code {code}"
    if code is not None and code < 0:
        how = f"was ended by signal {-code} ({(signal.strsignal(-code) or 'unknown').lower()})"
    return CannotRunError(
        f"The process that ran the sweep {how}.",
        "What is done is kept, and `tune-jobs resume` continues it. "
        f"Look for the cause on standard error and in {DRIVER_LOG}.",
    )

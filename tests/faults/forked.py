"""Commands of tune-jobs as forks of this process, which has imported what they need: they begin seconds sooner.

A fork is made before there is a Ray in this process, so each command is the driver of a sweep with a Ray of its own, in
a session of its own, and is killed as one that a shell started.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import subprocess
import sys
import time
import traceback
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from tests.kills.processes import end_with_parent

_LOOK_S = 0.01


class Process(Protocol):
    """As much of a process as faults need: a fork, or one of `subprocess`."""

    @property
    def pid(self) -> int:
        """Its id."""

    def poll(self) -> int | None:
        """Its exit code; None: it runs."""

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its exit code."""

    def kill(self) -> None:
        """Send it SIGKILL."""

    def send_signal(self, sig: int, /) -> None:
        """Send it a signal."""


class Forked:
    """A command that runs in a fork.

    Args:
        command: The program's path and its arguments.
        folder: To run it in.
        environment: All its variables.
        output: A file for what it prints.
        num_cpus: For its Ray.
    """

    def __init__(
        self, command: Sequence[str], folder: Path, environment: Mapping[str, str], output: Path, num_cpus: int
    ) -> None:
        import_all()
        sys.stdout.flush()
        sys.stderr.flush()
        self._code: int | None = None
        self.pid = os.fork()
        if self.pid == 0:
            _be(command, folder, environment, output, num_cpus)

    def poll(self) -> int | None:
        """Its exit code, as `subprocess` has it; None: it runs."""
        if self._code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self._code = os.waitstatus_to_exitcode(status)
        return self._code

    def wait(self, timeout: float | None = None) -> int:
        """Wait so many seconds for its exit code.

        Raises:
            subprocess.TimeoutExpired: It still runs.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            if deadline is not None and time.monotonic() > deadline:
                raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
            time.sleep(_LOOK_S)
        return code

    def send_signal(self, sig: int, /) -> None:
        """Send it a signal, if it runs."""
        if self.poll() is None:
            os.kill(self.pid, sig)

    def kill(self) -> None:
        """Send it SIGKILL."""
        self.send_signal(signal.SIGKILL)


def import_all() -> None:
    """Import what drives a sweep; it starts no thread and no Ray."""
    from tune_jobs.ray_tune.environment import prepare_environment

    # Ray reads some of it when it is imported.
    prepare_environment()
    import tune_jobs.cli.commands
    import tune_jobs.cli.output
    import tune_jobs.ray_tune.cluster
    import tune_jobs.ray_tune.run_trials
    import tune_jobs.sweeps.verbs  # noqa: F401


@contextlib.contextmanager
def _with_ray(num_cpus: int) -> Iterator[None]:
    """Start Ray and a process for environments at once, as a driver of the service does while it waits for a job."""
    from policies.guard.guard import guarding
    from tune_jobs.plan.machine import local_machine
    from tune_jobs.ray_tune.warm import warm_ray

    machine = replace(local_machine(), num_cpus=num_cpus)
    with guarding(start=True), warm_ray(machine):
        yield


def _be(command: Sequence[str], folder: Path, environment: Mapping[str, str], output: Path, num_cpus: int) -> None:
    """Be the command from now on, in a fork; never returns."""
    code = 1
    try:
        end_with_parent()
        os.setsid()
        os.chdir(folder)
        for path, flags, numbers in ((os.devnull, os.O_RDONLY, (0,)), (output, os.O_WRONLY | os.O_APPEND, (1, 2))):
            descriptor = os.open(path, flags)
            for number in numbers:
                os.dup2(descriptor, number)
            os.close(descriptor)
        os.environ.clear()
        os.environ.update(environment)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        # What Ray passes on to its processes is the program's, not this module's.
        sys.argv[:] = command
        program = types.ModuleType("__main__")
        program.__file__ = command[0]
        sys.modules["__main__"] = program
        from tune_jobs.cli.commands import main

        with _with_ray(num_cpus):
            main()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:  # noqa: BLE001 (nothing of the parent's may run here)
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            # Ray's among them; `os._exit` calls none.
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)

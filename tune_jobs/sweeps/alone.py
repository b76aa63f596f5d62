"""Let functions that run a sweep be the only one of their process, in its main thread."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, ParamSpec

if TYPE_CHECKING:
    from tune_jobs.sweeps.outcome import SweepResult

from tune_jobs.process.interruption import can_drive, taking_signals
from tune_jobs.sweeps.interrupted import SweepInterrupted

_Arguments = ParamSpec("_Arguments")


def run_alone(call: Callable[_Arguments, SweepResult]) -> Callable[_Arguments, SweepResult]:
    """Decorate a function that runs a sweep: it is the only one of its process, and ends cleanly at a signal.

    If this process runs a sweep already, or in a thread other than the main one, the function is called in a process of
    its own. So it has to be defined at the top of its module, with strings, paths and numbers as arguments.

    Raises:
        SweepInterrupted: A signal came; the records are written.
    """

    @functools.wraps(call)
    def run(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> SweepResult:
        if not can_drive():
            from tune_jobs.sweeps.apart import call_apart

            return call_apart(f"{call.__module__}:{call.__qualname__}", args, kwargs)
        # Imported here because it needs NumPy, which a command that only prints help does not.
        from tune_jobs.process.state import given_back

        with taking_signals() as interruption:
            with contextlib.ExitStack() as stack:
                stack.enter_context(given_back())
                # A signal that comes while the process is restored has nothing left to end.
                stack.callback(interruption.shield)
                try:
                    result = call(*args, **kwargs)
                except KeyboardInterrupt as error:
                    raise SweepInterrupted from error
            if interruption.came:
                raise SweepInterrupted(dataclasses.replace(result, interrupted=True))
            return result

    return run

"""Functions that run a sweep: each the only one of its process, in its main thread."""

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
    """Make a function that runs a sweep the only one of its process, end in order at a signal, and leave no traces.

    Where this process runs a sweep already, and in other threads than the main one, it is called in a process of its
    own: the function is public there, at the top of its module, and its arguments are texts, paths and numbers.

    Raises:
        SweepInterrupted: A signal came; the records are written.
    """

    @functools.wraps(call)
    def run(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> SweepResult:
        if not can_drive():
            from tune_jobs.sweeps.apart import call_apart

            return call_apart(f"{call.__module__}:{call.__qualname__}", args, kwargs)
        # It needs NumPy, which a program that only asks for help does not.
        from tune_jobs.process.state import given_back

        with taking_signals() as interruption:
            with contextlib.ExitStack() as stack:
                stack.enter_context(given_back())
                # What comes while the process is put back as it was has nothing left to cut short.
                stack.callback(interruption.shield)
                try:
                    result = call(*args, **kwargs)
                except KeyboardInterrupt as error:
                    raise SweepInterrupted from error
            if interruption.came:
                raise SweepInterrupted(dataclasses.replace(result, interrupted=True))
            return result

    return run

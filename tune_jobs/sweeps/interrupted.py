"""A sweep that is ended by a signal: everything is saved, then SweepInterrupted is raised."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, ParamSpec

if TYPE_CHECKING:
    from tune_jobs.sweeps.outcome import SweepResult

from tune_jobs.process.interruption import taking_signals

_Arguments = ParamSpec("_Arguments")


class SweepInterrupted(KeyboardInterrupt):
    """A launch, resume or extend was ended by Ctrl-C, SIGTERM or SIGHUP; what was done is saved.

    A `KeyboardInterrupt`, so that it ends the script that launched, also a loop over launches with an
    `except Exception` in it.

    Args:
        result: What there is of the sweep; None: it had not begun, and what was there before is as it was.
    """

    def __init__(self, result: SweepResult | None = None) -> None:
        super().__init__("The sweep was interrupted.")
        self.result = result


def run_alone(call: Callable[_Arguments, SweepResult]) -> Callable[_Arguments, SweepResult]:
    """Make a function that runs a sweep the only one of its process, end in order at a signal, and leave no traces.

    Raises:
        SweepInterrupted: A signal came; the records are written.
        CannotRunError: Another thread of this process runs a sweep.
    """

    @functools.wraps(call)
    def run(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> SweepResult:
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

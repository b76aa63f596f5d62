"""Handle signals while a sweep is launched, resumed or extended: they end it cleanly at any moment.

Ctrl-C (SIGINT), SIGTERM and a terminal that went away (SIGHUP) mean the same. While trials run, the first one asks
them to save a checkpoint and stop; the second ends them. At any other time the first one ends the present work.
In both cases the records are written, Ray is shut down and the locks are freed before `SweepInterrupted` is raised.

A SIGHUP never counts as the second signal: when a terminal goes away, a shell and the system may both send it, and a
sender of SIGTERM may send it too. If this process ignores SIGHUP, as nohup wants, it stays ignored. `ASKED`, which a
process sends to another that runs a sweep for it, never counts as the second one either, as Ctrl-C reaches both.

Python handles signals in the main thread. A sweep for another thread is run in a process of its own.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from tune_jobs.process.arrivals import noting_arrivals

ASKED = signal.SIGUSR1
EXIT_CODE = 130
"""Of a process whose sweep was interrupted."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def last_words(how_to_resume: str, *, is_done: bool = False) -> str:
    """Return what is said of a sweep that was interrupted, with the command that continues it.

    Args:
        how_to_resume: The command.
        is_done: Whether all trials are done.
    """
    kept = "all trials are done. Make what is missing with" if is_done else "what is done is kept. Continue with"
    return f"Interrupted; {kept}: {how_to_resume}"


class Interruption:
    """Decides what signals do at the moment, and knows whether one came.

    Args:
        has_acted: Whether a signal has ended an earlier part of the run.
    """

    def __init__(self, *, has_acted: bool = False) -> None:
        self.came = False
        """Whether a signal came."""
        self._has_acted = has_acted
        """Whether a signal had an effect, and was not only noted."""
        self._num_shields = 0
        self._ask: Callable[[], None] | None = None
        self._arrived: Callable[[], frozenset[int]] = frozenset

    def has_arrived(self) -> bool:
        """Whether a signal came, though its handler may not have been called: the main thread may be in native code.

        Any thread may ask this.
        """
        return self.came or not self._arrived().isdisjoint((*_SIGNALS, ASKED))

    @contextlib.contextmanager
    def noting(self) -> Iterator[None]:
        """Know of signals that arrive in the block at once, for `has_arrived`; for the main thread."""
        with noting_arrivals() as self._arrived:
            yield

    def take(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002 (the signature of a handler)
        """Handle a signal: ask the trials to stop, only note it, or raise an error.

        Raises:
            KeyboardInterrupt: There is nothing to ask (any more), and nothing that must not be cut short.
        """
        _taken.append(number)
        self.came = True
        if self._num_shields:
            return
        ask, self._ask = self._ask, None
        is_echo = number in (signal.SIGHUP, ASKED) and self._has_acted
        self._has_acted = True
        if ask is not None:
            # Not a second signal: one that comes at this moment was sent together with this one.
            with self.shielded():
                ask()
        elif not is_echo:
            raise KeyboardInterrupt

    @contextlib.contextmanager
    def asking(self, ask: Callable[[], None]) -> Iterator[None]:
        """Let the first signal in the block call a function, and the second raise KeyboardInterrupt."""
        self._ask = ask
        try:
            yield
        finally:
            self._ask = None

    def shield(self) -> None:
        """Let signals only be noted from now on."""
        self._num_shields += 1

    @contextlib.contextmanager
    def shielded(self) -> Iterator[None]:
        """Let signals in the block only be noted: it writes or frees something, and is soon over."""
        self.shield()
        try:
            yield
        finally:
            self._num_shields -= 1


_current = Interruption()
_is_driving = False
_taken: list[int] = []


def current() -> Interruption:
    """Return the interruption of the sweep that the main thread runs; other threads get no signals."""
    return _current if _is_main_thread() else Interruption()


def can_drive() -> bool:
    """Whether a sweep can be run here: in the main thread, of a process that runs no other sweep.

    A running sweep owns the process's signals, its standard output and its connection to Ray.
    """
    return _is_main_thread() and not _is_driving


def num_taken() -> int:
    """Return how many signals have come to the sweeps that this process has run in its main thread."""
    return len(_taken)


def was_taken(number: int) -> bool:
    """Return whether a signal has come to this process, while it ran a sweep or at another time."""
    return number in _taken


def main_thread_was_interrupted() -> bool:
    """Whether an uncaught KeyboardInterrupt has ended the main thread, and the process waits for other threads."""
    ended_by = getattr(sys, "last_type", None)
    return not threading.main_thread().is_alive() and ended_by is not None and issubclass(ended_by, KeyboardInterrupt)


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


@contextlib.contextmanager
def taking_signals() -> Iterator[Interruption]:
    """Handle this process's signals while the block runs a sweep.

    Raises:
        RuntimeError: `can_drive` is false.
    """
    global _current, _is_driving
    if not can_drive():
        raise RuntimeError("A sweep must be run by the main thread of a process that runs no other sweep.")
    interruption = Interruption()
    try:
        _current, _is_driving = interruption, True
        with interruption.noting(), _handled(interruption):
            yield interruption
    finally:
        _current, _is_driving = Interruption(has_acted=interruption.came), False


def end_in_order(*more: int) -> None:
    """Let SIGTERM and SIGHUP do what Ctrl-C does from now on, for a program of ours.

    Args:
        more: More signals that shall do the same.
    """
    for number in (*_SIGNALS, *more):
        if not _is_ignored(number):
            signal.signal(number, _take_now)


def _take_now(number: int, frame: FrameType | None) -> None:
    """Handle a signal outside of sweeps; one that comes soon after a sweep may be an echo of the one that ended it."""
    _current.take(number, frame)


def _is_ignored(number: int) -> bool:
    return number == signal.SIGHUP and signal.getsignal(number) == signal.SIG_IGN


@contextlib.contextmanager
def _handled(interruption: Interruption) -> Iterator[None]:
    before = {}
    try:
        for number in _SIGNALS:
            handler = signal.getsignal(number)
            # None: the handler was not set from Python, so it could not be restored.
            if handler is not None and not _is_ignored(number):
                before[number] = handler
                signal.signal(number, interruption.take)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

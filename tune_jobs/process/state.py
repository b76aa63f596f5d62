"""Restore what running a sweep changes in its process, so that the script or notebook around it can continue.

Ray and Ray Tune set environment variables, handlers of signals and exceptions, loggers and limits, and leave them so.
"""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import os
import random
import resource
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from policies.envs.modules import allowed_again
from policies.standard_streams import standard_streams

# Variables that a user's own module sets when it is imported are kept, because it is not imported again.
_VARIABLES = ("RAY_", "TUNE_", "GRPC_", "PYTHONPATH", "PYTHONBREAKPOINT", "SDL_", "PYGAME_HIDE_SUPPORT_PROMPT")


@contextlib.contextmanager
def given_back() -> Iterator[None]:
    """Restore what the block changes in this process."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(standard_streams())
        stack.enter_context(warnings.catch_warnings())
        stack.enter_context(allowed_again())
        for keep in (_variables, _hooks, _signal_handlers, _loggers, randomness_given_back, _file_limit):
            stack.enter_context(keep())
        yield


_before_sweep: dict[str, str] | None = None
"""The variables of Ray and tune-jobs as they were before the sweep that this process runs."""


def environment() -> dict[str, str]:
    """Return this process's environment variables as before its sweep, for a process that runs another sweep."""
    ours, before = _our_variables(), _before_sweep
    if before is None:
        return dict(os.environ)
    return {name: value for name, value in os.environ.items() if name not in ours} | before


@contextlib.contextmanager
def _variables() -> Iterator[None]:
    global _before_sweep  # noqa: PLW0603 (a process has one environment)
    before = _before_sweep = _our_variables()
    try:
        yield
    finally:
        _before_sweep = None
        for name in _our_variables().keys() - before.keys():
            os.environ.pop(name, None)
        os.environ.update(before)


def _our_variables() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name.startswith(_VARIABLES)}


@contextlib.contextmanager
def _hooks() -> Iterator[None]:
    hook, thread_hook, dumps = sys.excepthook, threading.excepthook, faulthandler.is_enabled()
    try:
        yield
    finally:
        sys.excepthook, threading.excepthook = hook, thread_hook
        if not dumps:
            faulthandler.disable()


@contextlib.contextmanager
def _signal_handlers() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in signal.valid_signals()}
    try:
        yield
    finally:
        for number, handler in before.items():
            # None: the handler was not set from Python, so it cannot be restored from Python.
            if handler is not None and signal.getsignal(number) != handler:
                signal.signal(number, handler)


@contextlib.contextmanager
def _loggers() -> Iterator[None]:
    """Restore the loggers that exist; what importing ray sets up for its own loggers stays, as with any import."""
    factory = logging.getLogRecordFactory()
    names = [None, *logging.root.manager.loggerDict]
    before = {name: _settings(logging.getLogger(name)) for name in names}
    try:
        yield
    finally:
        logging.setLogRecordFactory(factory)
        for name, (level, handlers, propagate, disabled) in before.items():
            logger = logging.getLogger(name)
            if logger.level != level:
                logger.setLevel(level)
            logger.handlers[:] = handlers
            logger.propagate, logger.disabled = propagate, disabled


def _settings(logger: logging.Logger) -> tuple[int, list[logging.Handler], bool, bool]:
    return logger.level, list(logger.handlers), logger.propagate, logger.disabled


@contextlib.contextmanager
def randomness_given_back() -> Iterator[None]:
    """Restore the state of the global generators, and what torch may do at random, if torch is already loaded.

    RLlib seeds them all for each Algorithm with a seed, and has torch do nothing at random from then on.
    """
    python, numpy = random.getstate(), np.random.get_state()  # noqa: NPY002 (other people's)
    torch: Any = sys.modules.get("torch")
    restore_torch = None if torch is None else _of_torch(torch)
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy)  # noqa: NPY002
        if restore_torch is not None:
            restore_torch()


def _of_torch(torch: Any) -> Callable[[], None]:
    """Return what restores torch's present state."""
    drawn, num_threads, cudnn = torch.get_rng_state(), torch.get_num_threads(), torch.backends.cudnn
    drawn_on_gpus = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else None
    of_cudnn = cudnn.deterministic, cudnn.benchmark
    is_exact, warns = torch.are_deterministic_algorithms_enabled, torch.is_deterministic_algorithms_warn_only_enabled
    exact = is_exact(), warns()

    def restore() -> None:
        torch.set_rng_state(drawn)
        if drawn_on_gpus is not None:
            torch.cuda.set_rng_state_all(drawn_on_gpus)
        if (cudnn.deterministic, cudnn.benchmark) != of_cudnn:  # they can't be set where a program froze them
            cudnn.deterministic, cudnn.benchmark = of_cudnn
        if (is_exact(), warns()) != exact:
            torch.use_deterministic_algorithms(exact[0], warn_only=exact[1])
        if torch.get_num_threads() != num_threads:
            torch.set_num_threads(num_threads)

    return restore


@contextlib.contextmanager
def _file_limit() -> Iterator[None]:
    """Restore the limit of open files, which Ray raises for this process and its children."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, before)

"""A Ray of this machine that is started before there is a sweep, with processes that have imported what trials need."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator

from tune_jobs.plan.machine import Machine
from tune_jobs.ray_tune.cluster import connect

_PRELOAD = "RAY_preload_python_modules"
_MODULES = ("tune_jobs.ray_tune.pack_trainable", "tune_jobs.training.packed", "policies.packed.make", "torch")


@contextlib.contextmanager
def warm_ray(machine: Machine, meanwhile: Callable[[], object] | None = None) -> Iterator[None]:
    """Start Ray for the block; a sweep that is run in it finds Ray and its processes there.

    Args:
        machine: The CPUs and GPUs to start Ray with.
        meanwhile: What to do while Ray starts, in this thread.

    Raises:
        CannotRunError: Ray does not start.
    """
    before = os.environ.get(_PRELOAD)
    os.environ[_PRELOAD] = ",".join(_MODULES)
    try:
        with connect(None, machine, is_users=True, meanwhile=meanwhile):
            yield
    finally:
        if before is None:
            os.environ.pop(_PRELOAD, None)
        else:
            os.environ[_PRELOAD] = before

"""A Ray of this machine that is started before there is a sweep, with processes that have imported what trials need."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any

from tune_jobs.plan.machine import Machine
from tune_jobs.ray_tune.cluster import connect

_PRELOAD = "RAY_preload_python_modules"
_MODULES = ("tune_jobs.ray_tune.pack_trainable", "tune_jobs.training.packed", "policies.packed.make", "torch")


@contextlib.contextmanager
def warm_ray(machine: Machine) -> Iterator[None]:
    """Start Ray for the block; a sweep that is run in it finds Ray and its processes there.

    Args:
        machine: The CPUs and GPUs to start Ray with.

    Raises:
        CannotRunError: Ray does not start.
    """
    before = os.environ.get(_PRELOAD)
    os.environ[_PRELOAD] = ",".join(_MODULES)
    try:
        with connect(None, machine, is_users=True), _without_own_environment():
            yield
    finally:
        if before is None:
            os.environ.pop(_PRELOAD, None)
        else:
            os.environ[_PRELOAD] = before


@contextlib.contextmanager
def _without_own_environment() -> Iterator[None]:
    """Let Tune's actors have Ray's usual environment.

    Ray 2.60's Tune gives each actor a runtime environment, for one variable of PyTorch Lightning and what it passes on
    to other machines; so Ray starts new processes, and those that wait with everything imported are of no use. Nothing
    public turns that off.
    """
    import ray
    from ray.tune.execution import class_cache

    cache: Any = class_cache._ActorClassCache  # noqa: SLF001
    original = cache.get

    def get(self: Any, trainable: type[Any]) -> Any:
        known = self._cache
        if trainable not in known:
            known[trainable] = ray.remote(trainable)
        return known[trainable]

    cache.get = get
    try:
        yield
    finally:
        cache.get = original

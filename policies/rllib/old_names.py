"""Provide the old names of modules, which older checkpoints of the rllib engine are pickled with."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from importlib import import_module
from types import ModuleType
from typing import Any

# Names in pickles of sweeps up to format 2. `policies.networks` is a package now, which still has the two classes.
_MOVED = {
    "policies.dqn_algorithm": "policies.rllib.dqn_algorithm",
    "policies.dqn_learner": "policies.rllib.dqn_learner",
    "policies.env_runner": "policies.rllib.env_runner",
    "policies.exploration": "policies.networks.exploration",
    "policies.ppo_learner": "policies.rllib.ppo_learner",
    "tune_jobs.engines.env_runner": "tune_jobs.training.env_runner",
}


class _Moved(ModuleType):
    """A module under its old name: it has what it had then, and what a user's own module of this name has."""

    def __init__(self, name: str, theirs: ModuleType | None) -> None:
        super().__init__(name)
        self._theirs = theirs

    def __getattr__(self, name: str) -> Any:
        ours = import_module(_MOVED[self.__name__])
        return getattr(ours if self._theirs is None or hasattr(ours, name) else self._theirs, name)


@contextlib.contextmanager
def old_names() -> Iterator[None]:
    """Let pickles that are loaded in the block use the old names of modules."""
    before = {name: sys.modules.get(name) for name in _MOVED}
    sys.modules.update({name: _Moved(name, theirs) for name, theirs in before.items()})
    try:
        yield
    finally:
        for name, theirs in before.items():
            del sys.modules[name]
            if theirs is not None:
                sys.modules[name] = theirs

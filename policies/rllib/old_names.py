"""Names of before the modules moved into packages, which checkpoints of the rllib engine are pickled with."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from importlib import import_module
from types import ModuleType
from typing import Any

# In pickles of sweeps up to format 2. `policies.networks` is a package now, which has its two classes still.
_MOVED = {
    "policies.dqn_algorithm": "policies.rllib.dqn_algorithm",
    "policies.dqn_learner": "policies.rllib.dqn_learner",
    "policies.env_runner": "policies.rllib.env_runner",
    "policies.exploration": "policies.networks.exploration",
    "policies.ppo_learner": "policies.rllib.ppo_learner",
    "tune_jobs.engines.env_runner": "tune_jobs.training.env_runner",
}


class _Moved(ModuleType):
    """A module by its old name: what it had, and what a user's own module of this name has."""

    def __init__(self, name: str, theirs: ModuleType | None) -> None:
        super().__init__(name)
        self._theirs = theirs

    def __getattr__(self, name: str) -> Any:
        ours = import_module(_MOVED[self.__name__])
        return getattr(ours if self._theirs is None or hasattr(ours, name) else self._theirs, name)


@contextlib.contextmanager
def old_names() -> Iterator[None]:
    """Let what is unpickled in the block name modules as they were called before."""
    before = {name: sys.modules.get(name) for name in _MOVED}
    sys.modules.update({name: _Moved(name, theirs) for name, theirs in before.items()})
    try:
        yield
    finally:
        for name, theirs in before.items():
            del sys.modules[name]
            if theirs is not None:
                sys.modules[name] = theirs

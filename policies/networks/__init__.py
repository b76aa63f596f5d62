"""Layers and parts of networks, and the RLModules of PPO and DQN, which a user's own RLModules may derive from."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from policies.networks.rl_modules import DQNModule as DQNModule
    from policies.networks.rl_modules import PPOModule as PPOModule

_CLASSES = ("DQNModule", "PPOModule")


def __getattr__(name: str) -> Any:
    # Imported only here, because packs use layers and parts of this package without loading RLlib.
    if name not in _CLASSES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(_CLASSES)}")
    return getattr(import_module("policies.networks.rl_modules"), name)

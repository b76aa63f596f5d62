"""What the actions of an environment are called, where somebody has said so: who watches reads names, not numbers."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

# As Gymnasium's own pages name them; the environments themselves don't say.
_NAMES: dict[str, tuple[str, ...]] = {
    "Acrobot": ("torque -1", "no torque", "torque +1"),
    "CartPole": ("push left", "push right"),
    "LunarLander": ("do nothing", "fire left engine", "fire main engine", "fire right engine"),
    "MountainCar": ("push left", "don't push", "push right"),
}


def action_names(env: gym.Env[Any, Any]) -> tuple[str, ...] | None:
    """Return the names of an environment's discrete actions in their order; None: they have none.

    They are those of its own `get_action_meanings()`, which Atari's have, else those known of Gymnasium's own.
    """
    space = env.action_space
    if not isinstance(space, gym.spaces.Discrete):
        return None
    names = _said_by(env.unwrapped) or _known(env)
    return names if names is not None and len(names) == int(space.n) else None


def _said_by(env: Any) -> tuple[str, ...] | None:
    try:
        names = env.get_action_meanings()
    except Exception:  # noqa: BLE001 (an env may have none, or raise anything: its names are no more than a help)
        return None
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        return None
    return tuple(name[:40] for name in names)


def _known(env: gym.Env[Any, Any]) -> tuple[str, ...] | None:
    spec = env.spec
    return _NAMES.get(spec.name) if spec is not None and spec.namespace is None else None

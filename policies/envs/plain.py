"""Tell environments with nothing around them that changes what they give."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.wrappers import OrderEnforcing, TimeLimit

_PLAIN = (TimeLimit, OrderEnforcing)


def is_plain(env: gym.Env[Any, Any]) -> bool:
    """Whether nothing but Gymnasium's time limit is around an environment."""
    while type(env) in _PLAIN:
        env = env.env  # type: ignore[attr-defined]
    return env is env.unwrapped

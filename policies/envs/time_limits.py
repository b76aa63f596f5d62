"""After how many env steps an environment cuts off its episodes, wherever among its wrappers that is."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.wrappers import TimeLimit

_PASS_ON = ("gymnasium", "policies")
"""Whose wrappers make one step of the environment for one of their own, and end an episode where it does, at least."""


def time_limit_of(env: gym.Env[Any, Any]) -> int | None:
    """Return the number of env steps after which an episode is truncated, the least of the limits around the env.

    An environment that is a wrapper around one of `gymnasium.make` has that one's limit inside, which goes on to act
    when a larger one is set around both. Where such a wrapper makes steps of its own, it may go on after an episode
    that ends inside, or make several steps of one: limits inside it say nothing of its episodes.

    Args:
        env: The environment with all its wrappers; those in a process of its own are not seen.
    """
    # What `env.spec` says is also a limit's from inside, whatever is around it.
    limits: list[int] = []
    inner: gym.Env[Any, Any] = env
    while isinstance(inner, gym.Wrapper) and _passes_on(type(inner)):
        if isinstance(inner, TimeLimit):
            limits.append(inner._max_episode_steps)  # noqa: SLF001 - Gymnasium has no public name for it
        inner = inner.env
    return min(limits, default=None)


def _passes_on(wrapper: type[gym.Wrapper[Any, Any, Any, Any]]) -> bool:
    is_known = wrapper.__module__.partition(".")[0] in _PASS_ON
    return is_known or wrapper.step is gym.Wrapper.step

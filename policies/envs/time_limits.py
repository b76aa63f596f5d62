"""After how many env steps an environment cuts off its episodes, wherever among its wrappers that is."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.wrappers import AtariPreprocessing, TimeLimit

from policies.errors import EnvError

_PASS_ON = ("gymnasium", "policies")
"""Whose steps are one step of the environment inside each, and end an episode where it does, at least."""


def check_limit(env_id: str, limit: Any) -> None:
    """Refuse an env argument `max_episode_steps` that is no limit.

    Raises:
        EnvError: It is none.
    """
    if isinstance(limit, bool) or not isinstance(limit, int) or limit < 1:
        raise EnvError(
            f"The env argument 'max_episode_steps' of {env_id} is {limit!r}; it must be a whole number >= 1.",
            "Correct it, or leave it out to keep the env's own limit.",
        )


def time_limit_of(env: gym.Env[Any, Any]) -> int | None:
    """Return the number of env steps after which an episode is truncated, the least of the limits around the env.

    An environment that is a wrapper around one of `gymnasium.make` has that one's limit inside, which goes on to act
    when a larger one is set around both. A wrapper whose `step` is its own may go on after an episode that ends inside,
    or make several steps of one: if there is a limit around it, those inside it say nothing.

    Args:
        env: The environment with all its wrappers; those in a process of its own are not seen.
    """
    # That of the outermost limit, be it inside a wrapper that does whatever it likes: most only look at what passes.
    limits = [] if env.spec is None or env.spec.max_episode_steps is None else [env.spec.max_episode_steps]
    inner: gym.Env[Any, Any] = env
    while isinstance(inner, gym.Wrapper) and _passes_on(type(inner)):
        if isinstance(inner, TimeLimit):
            limits.append(inner._max_episode_steps)  # noqa: SLF001 - Gymnasium has no public name for it
        inner = inner.env
    return min(limits, default=None)


def _passes_on(wrapper: type[gym.Wrapper[Any, Any, Any, Any]]) -> bool:
    # Gymnasium's preprocessing of Atari games takes several frames a step.
    return not issubclass(wrapper, AtariPreprocessing) and wrapper.step.__module__.partition(".")[0] in _PASS_ON

"""After how many env steps an environment cuts off its episodes, wherever among its wrappers that is."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.wrappers import TimeLimit

from policies.errors import EnvError


def checked_time_limit(env: gym.Env[Any, Any], env_id: str, asked: int | None) -> int | None:
    """Return the number of env steps after which an episode is truncated, the least of all limits around the env.

    An environment that is a wrapper around one of `gymnasium.make` has that one's limit inside, which goes on to act
    when a larger one is set around both.

    Args:
        env: The environment with all its wrappers; those in a process of its own are not seen.
        env_id: Its id, for messages.
        asked: `max_episode_steps` of the sweep file; None: it sets none.

    Returns:
        The limit in env steps; None if there is none.

    Raises:
        EnvError: The limit that was asked for never acts, as there is a smaller one inside.
    """
    limits = [] if env.spec is None or env.spec.max_episode_steps is None else [env.spec.max_episode_steps]
    inner: gym.Env[Any, Any] = env
    while isinstance(inner, gym.Wrapper):
        if isinstance(inner, TimeLimit):
            limits.append(inner._max_episode_steps)  # noqa: SLF001  (Gymnasium has no public name for it)
        inner = inner.env
    least = min(limits, default=None)
    if asked is not None and least is not None and least < asked:
        raise EnvError(
            f"The env argument 'max_episode_steps' of {env_id} is {asked:,}, which never acts: the environment has a "
            f"limit of {least:,} env steps inside.",
            f"Make the one inside with gymnasium.make(..., max_episode_steps=-1), or set {least} or fewer here.",
        )
    return least

"""Make the loop over copies of an environment that has no vectorised version of its own."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, load_env_creator

from policies.envs.ids import as_creator


def make_loop(spec: EnvSpec, **kwargs: Any) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Run `gymnasium.make_vec` for a loop over copies, each with lists, dicts and sets of its own as arguments.

    Gymnasium hands all copies the same ones, which what one writes into them would change for the others.
    """
    entry = spec.entry_point
    if entry is not None:  # otherwise Gymnasium says so
        creator = as_creator(load_env_creator(entry) if isinstance(entry, str) else entry)
        entry = partial(_make, creator)
        if hasattr(creator, "metadata"):  # by which gym.make knows which render modes there are
            vars(entry)["metadata"] = creator.metadata
    own = replace(spec, entry_point=entry)
    return gym.make_vec(own, vectorization_mode="sync", disable_env_checker=True, **kwargs)


def _make(creator: Callable[..., Any], /, **env_args: Any) -> Any:
    return creator(**_own(env_args))


def _own(value: Any) -> Any:
    """Copy lists, dicts and sets, also those in each other; what else they hold, which may be large, is shared."""
    if type(value) is tuple:
        return tuple(map(_own, value))
    if not isinstance(value, dict | list | set):
        return value
    own: Any = copy.copy(value)  # of its class
    if isinstance(value, dict):
        own.update((key, _own(each)) for key, each in value.items())
    elif isinstance(value, list):
        own[:] = map(_own, value)
    return own

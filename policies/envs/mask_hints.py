"""Suggest what an environment's mask of actions is called, where it is not found, or not given."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from policies.envs.mask_values import checked_mask
from policies.envs.masks import ACTION_MASK, METHOD, MaskedBox, Setting, member_problem, needs_nothing
from policies.envs.own_actions import sizes_of

_LIKE_MASKS = re.compile("mask|legal|valid|allowed")
_IS_CALLED_MASK = re.compile("(?=.*mask)(?=.*(?:action|move|legal|valid|allowed))")
"""Of a method, whose name is all that is known of it."""


class UnusedMask(NamedTuple):
    """What looks like a mask of actions and is not used."""

    place: str
    """Where it is, in words, as `EnvInfo.mask` has it."""
    setting: str
    """The value of `env.action_mask`, as a sweep file has it, with which it is used."""


def mask_hint(env: gym.Env[Any, Any], infos: Any) -> str:
    """Suggest the setting for an environment that has no mask of the name that is set.

    Args:
        env: The environment, with its wrappers.
        infos: The infos of its reset.
    """
    names = [*_infos(env, infos), *_members(env), *_methods(env)]
    if not names:
        return f"Set env.{ACTION_MASK}: false, or leave it out: nothing of the env looks like a mask."
    return f"Write env.{ACTION_MASK}: {' or '.join(dict.fromkeys(names))}; or false, if that is no mask."


def argument_hint(space: MaskedBox, setting: Setting) -> str:
    """Say how to give a policy the mask, as words behind what else it is given; nothing, if that has the mask.

    Args:
        space: What the policy observes.
        setting: What the environment's arguments say of its mask.
    """
    if space.key is not None:
        return ""
    if space.original is None:
        return ", and the newest mask of the environment as mask="
    name, method = (setting, setting) if isinstance(setting, str) else (ACTION_MASK, METHOD)
    called = f'mask=env.get_wrapper_attr("{method}")()'
    # Without a setting, a mask that is no member is a method.
    return f", and {called}" if setting is None else f', and mask=info["{name}"], or {called} if it is a method'


def unused_mask(env: gym.Env[Any, Any], infos: Mapping[str, Any]) -> UnusedMask | None:
    """Return what looks like a mask of an environment's actions by its name and form; None: nothing does.

    Args:
        env: The environment, with its wrappers, of which none uses a mask.
        infos: The infos of its reset.
    """
    if not (sizes := sizes_of(env.action_space)):
        return None
    value = infos.get(ACTION_MASK)
    if isinstance(value, np.ndarray) and value.size == sum(sizes):
        return UnusedMask(f"info[{ACTION_MASK!r}]", "true")
    for name in filter(_LIKE_MASKS.search, _infos(env, infos)):
        return UnusedMask(f"info[{name!r}]", name)
    for name in filter(_LIKE_MASKS.search, _members(env)):
        return UnusedMask(f"observation[{name!r}]", name)
    for name in _methods(env, _IS_CALLED_MASK):
        return UnusedMask(f"{name}()", name)
    return None


def _infos(env: gym.Env[Any, Any], infos: Any) -> Iterator[str]:
    for name, value in infos.items() if isinstance(infos, Mapping) else ():
        # What an info holds may be anything, and fail in any way.
        with contextlib.suppress(Exception):
            checked_mask(value, sizes_of(env.action_space))
            yield str(name)


def _members(env: gym.Env[Any, Any]) -> Iterator[str]:
    observed = env.unwrapped.observation_space
    if not isinstance(observed, gym.spaces.Dict):
        return
    for name, member in observed.spaces.items():
        is_binary = not isinstance(member, gym.spaces.Box) or bool((member.low >= 0).all() and (member.high <= 1).all())
        if is_binary and not member_problem(observed, name, sizes_of(env.action_space)):
            yield name


def _methods(env: gym.Env[Any, Any], like: re.Pattern[str] = _LIKE_MASKS) -> Iterator[str]:
    """Yield methods by their names alone: to call them might change the environment."""
    inner = env.unwrapped
    for name in dir(inner):
        if like.search(name) and not name.startswith("_"):
            # A property is computed, and may fail in any way.
            with contextlib.suppress(Exception):
                if needs_nothing(getattr(inner, name)):
                    yield name

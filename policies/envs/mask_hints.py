"""Suggest what an environment's mask of actions is called, where it is not found, or not given."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from policies.envs.mask_settings import ACTION_MASK, ACTIONS, Setting, names_in
from policies.envs.mask_values import checked_mask, listed_mask
from policies.envs.masks import MaskedBox, member_problem
from policies.envs.own_actions import sizes_of
from policies.envs.signatures import needs_nothing

_LIKE_MASKS = re.compile("mask|legal|valid|allowed")
_IS_CALLED_MASK = re.compile("(?=.*mask)(?=.*(?:action|move|legal|valid|allowed))")
"""Of a method, whose name is all that is known of it."""
_LIKE_LISTS = re.compile(
    "(?=.*(?:action|move))(?:(?<!in)(?:valid|feasible|admissible)|(?<!il)legal|(?<!dis)allowed|(?<!un)available"
    "|(?<!im)possible)"
)


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
    names = [*_infos(env, infos), *_lists(env, infos).values(), *_members(env), *_methods(env)]
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
    name, method = names_in(setting)
    called = f'mask=env.get_wrapper_attr("{method}")()'
    # Without a setting, a mask that is no member is a method.
    return f", and {called}" if setting is None else f', and mask=info["{name}"], or {called} if it is a method'


def unused_mask(env: gym.Env[Any, Any], infos: Mapping[str, Any]) -> UnusedMask | None:
    """Return what looks like a mask of an environment's actions by its name and form; None: nothing does.

    Args:
        env: The environment, with its wrappers, of which none uses a mask.
        infos: The infos of its reset.
    """
    sizes = sizes_of(env.action_space)
    return next(_like_masks(env, infos, sum(sizes)), None) if sizes else None


def _like_masks(env: gym.Env[Any, Any], infos: Mapping[str, Any], num_masked: int) -> Iterator[UnusedMask]:
    value = infos.get(ACTION_MASK)
    if isinstance(value, np.ndarray) and value.size == num_masked:
        yield UnusedMask(f"info[{ACTION_MASK!r}]", "true")
    for name in filter(_LIKE_MASKS.search, _infos(env, infos)):
        yield UnusedMask(f"info[{name!r}]", name)
    for name, setting in _lists(env, infos).items():
        yield UnusedMask(f"info[{name!r}]", setting)
    for name in filter(_LIKE_MASKS.search, _members(env)):
        yield UnusedMask(f"observation[{name!r}]", name)
    for name in _methods(env, _IS_CALLED_MASK):
        yield UnusedMask(f"{name}()", name)


def _infos(env: gym.Env[Any, Any], infos: Any) -> Iterator[str]:
    for name, value in infos.items() if isinstance(infos, Mapping) else ():
        # What an info holds may be anything, and fail in any way.
        with contextlib.suppress(Exception):
            checked_mask(value, sizes_of(env.action_space))
            yield str(name)


def _lists(env: gym.Env[Any, Any], infos: Any) -> dict[str, str]:
    """Return the infos that seem to list the actions that are allowed, each with the setting that uses it."""
    space = env.action_space
    if not isinstance(space, gym.spaces.Discrete) or not isinstance(infos, Mapping):
        return {}
    found = {}
    for name, value in infos.items():
        # What an info holds may be anything, and fail in any way.
        with contextlib.suppress(Exception):
            # A number that is there twice may be a part of anything.
            if _LIKE_LISTS.search(name) and len(set(value)) == len(value):
                listed_mask(value, int(space.n), int(space.start))
                found[name] = f"{{{ACTIONS}: {name}}}"
    return found


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

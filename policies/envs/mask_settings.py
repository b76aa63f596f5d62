"""What an environment's arguments say of its mask of actions: what it is called, and whether it lists actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias, cast

from policies.errors import EnvError

ACTION_MASK = "action_mask"
"""The key of an environment's arguments that names its mask, and the name of a mask that needs not be named."""
METHOD = "action_masks"
"""The method that needs not be named."""
ACTIONS = "actions"
"""The key of the name of a list of the actions that are allowed, where there are no zeros and ones."""

Setting: TypeAlias = str | bool | Mapping[str, str] | None


def is_setting(value: Any) -> bool:
    """Whether something is a name, {actions: a name}, true, false or None."""
    name = value[ACTIONS] if isinstance(value, Mapping) and set(value) == {ACTIONS} else value
    return value is None or isinstance(value, bool) or (isinstance(name, str) and bool(name))


def check_setting(setting: Any) -> Setting:
    """Return what an environment's arguments say of its mask.

    Raises:
        EnvError: It is neither a name, nor {actions: a name}, nor true or false.
    """
    if is_setting(setting):
        return cast("Setting", setting)
    raise EnvError(
        f"{ACTION_MASK} is {setting!r}; it must be the name of the mask, {{{ACTIONS}: the name of a list of the "
        "actions that are allowed}, true or false.",
        "Give the name of a member of the observations, of a method, or of an info; leave it out for 'action_mask'.",
    )


def names_in(setting: Setting) -> tuple[str, str]:
    """Return what a member or an info is called, and what a method is."""
    name = setting[ACTIONS] if isinstance(setting, Mapping) else setting
    return (name, name) if isinstance(name, str) else (ACTION_MASK, METHOD)


def lists_actions(setting: Setting) -> bool:
    """Whether what is named lists the actions that are allowed."""
    return isinstance(setting, Mapping)

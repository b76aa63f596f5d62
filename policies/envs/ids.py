"""Look up env ids: each means an entry of Gymnasium's registry, or a class in a module that was allowed.

The registry's entry is looked up here, and Gymnasium is never handed the id itself: it would import the module that an
id such as `module:Env-v0` names, allowed or not.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable
from functools import partial
from importlib.util import find_spec
from inspect import isfunction
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, find_highest_version, get_env_id, parse_env_id

from policies.envs.atari import INSTALL, is_atari_id
from policies.envs.modules import allowed_modules, import_module_allowed
from policies.envs.plugins import load_env_plugins
from policies.errors import EnvError, SpecError
from policies.suggestions import did_you_mean

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvCreator


def normalize_env_id(env_id: str) -> str:
    """Return the registered id that a user's id means: `CartPole` means the newest `CartPole-v<n>`.

    An id of the form `module:Name` keeps its module, so that other processes import it too.

    Raises:
        EnvError: The id is not a string, is empty or not registered, or its module is not allowed or does not have it.
    """
    return find_env(env_id)[0]


def find_env(env_id: str) -> tuple[str, EnvSpec]:
    """Return the normalised id, and the entry of Gymnasium's registry that the environment is made from.

    Args:
        env_id: A registered id, with its version or without; or `module:Name` with the name of one that the module
            registers, or of a subclass of `gymnasium.Env` in it.

    Raises:
        EnvError: In the same cases as `normalize_env_id`.
    """
    if not isinstance(env_id, str) or not env_id.strip():
        raise EnvError(
            f"The env id is {env_id!r}, which names no environment.",
            "Give a Gymnasium id such as 'CartPole-v1'.",
        )
    env_id = env_id.strip()
    if ":" in env_id:
        return _find_in_module(env_id)
    problems: tuple[str, ...] = ()
    found = _find_registered(env_id)
    if found is None:
        problems = load_env_plugins()
        found = _find_registered(env_id)
    if found is None:
        reasons = "".join(f" {problem}" for problem in problems)
        guess = _nearest_ids(env_id, gym.registry)
        hint = "Correct the id, or install the package that registers it."
        own = allowed_modules()
        if (home := _namespace_module(env_id)) is not None:
            hint += f" If the module {home} registers it, that is written {home}:{env_id}."
        elif own or not guess:
            example = own[0] if own else "my_envs"
            hint += f" What a module of your own registers is written module:id, as in {example}:Maze-v0."
        module, _, name = env_id.rpartition(".")
        if not guess and module and all(map(str.isidentifier, env_id.split("."))):
            guess = f" A class of a module is written module:Class: '{module}:{name}'."
        if is_atari_id(env_id) and not any(map(is_atari_id, gym.registry)):
            guess, hint = " It is a game of the Arcade Learning Environment, which is not installed.", INSTALL
        raise EnvError(f"No environment {env_id!r} is registered with Gymnasium.{guess}{reasons}", hint)
    return found, gym.registry[found]


def as_creator(maker: Callable[..., Any]) -> Callable[..., Any]:
    """Return what Gymnasium takes for a class or function that makes environments."""
    # Gymnasium reads the class's metadata, which of a Wrapper is a property.
    return partial(maker) if isinstance(getattr(maker, "metadata", None), property) else maker


def module_of(env_id: str) -> str | None:
    """Return the module that an id names, or None if it names none."""
    module, colon, _ = env_id.strip().partition(":")
    return module if colon else None


def _find_in_module(env_id: str) -> tuple[str, EnvSpec]:
    module_name, _, name = env_id.partition(":")
    try:
        module = import_module_allowed(module_name)
    except SpecError as error:
        raise EnvError(f"The env id {env_id!r} names a module before its colon. {error.message}", error.hint) from error
    found = _find_registered(name)
    thing: Any = getattr(module, name, None)
    is_class = isinstance(thing, type) and issubclass(thing, gym.Env)
    # A class of one's own may be called as an environment of another package is, without its version.
    if found is not None and (not is_class or _is_registered_by(found, module_name, thing.__module__)):
        return f"{module_name}:{found}", gym.registry[found]
    if is_class:
        return env_id, EnvSpec(env_id, entry_point=cast("EnvCreator", as_creator(thing)))
    classes = [
        name
        for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, gym.Env) and value.__module__ == module.__name__
    ]
    raise EnvError(
        f"The module {module_name!r} neither registers an environment {name!r} with Gymnasium nor has a class of that "
        f"name that is a gymnasium.Env.{_nearest_ids(name, [*classes, *gym.registry])}",
        _if_it_registers(module)
        or "Correct the name after the colon, or call gymnasium.register in the module when it is imported.",
    )


def _if_it_registers(module: ModuleType) -> str:
    """Return what to do with a module that has a function to register its environments; "": it has none."""
    for name, value in vars(module).items():
        if name.startswith("register") and isfunction(value) and _share_package(str(value.__module__), module.__name__):
            return (
                f"Correct the name after the colon, or, if {module.__name__}.{name}() registers it, call that in a "
                "module of your own, which then goes before the colon."
            )
    return ""


def _is_registered_by(env_id: str, *modules: str) -> bool:
    """Whether the environment of a registered id is made by the package of one of these modules."""
    entry = gym.registry[env_id].entry_point
    maker = entry.partition(":")[0] if isinstance(entry, str) else getattr(entry, "__module__", "")
    return any(_share_package(maker, module) for module in modules)


def _share_package(module: str, other: str) -> bool:
    return module.partition(".")[0] == other.partition(".")[0]


def _namespace_module(env_id: str) -> str | None:
    """Return the module that is called as an id's namespace, as of gym_pusht/PushT-v0; None: there is none."""
    name, slash, _ = env_id.replace("-", "_").partition("/")
    with contextlib.suppress(ValueError):  # an entry of sys.modules that was not imported from anywhere
        if slash and name.isidentifier() and find_spec(name) is not None:
            return name
    return None


def _find_registered(env_id: str) -> str | None:
    if env_id in gym.registry:
        return env_id
    try:
        namespace, name, version = parse_env_id(env_id)
        newest = find_highest_version(namespace, name) if version is None else None
    except gym.error.Error:  # the id is malformed
        return None
    return None if newest is None else get_env_id(namespace, name, newest)


def _nearest_ids(env_id: str, known: Iterable[str]) -> str:
    # Up to three, because the versions of one environment are equally near.
    return did_you_mean(env_id, known, at_most=3, cutoff=0.7)

"""Check and make Gymnasium environments.

Words: an *env id* names a registered environment (`CartPole-v1`); *env arguments* are the keyword arguments
its constructor takes; a *sub-environment* is one of the copies that a vector environment steps at once.

Environments are always made from the registry's entry, never by handing the id to Gymnasium: Gymnasium would
import the module that an id such as `module:Env-v0` names, which runs whatever code a sweep file or policy
file asks for.
"""

from __future__ import annotations

import copy
import difflib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import (
    EnvSpec,
    find_highest_version,
    get_env_id,
    load_env_creator,
    parse_env_id,
)

from policies.env_plugins import load_env_plugins
from policies.errors import EnvError
from policies.hyperparams import Algorithm

# Keyword arguments of gym.make and gym.make_vec that are set here and not by a sweep file.
_RESERVED_ARGS = frozenset(
    {
        "id",
        "render_mode",
        "disable_env_checker",
        "num_envs",
        "vectorization_mode",
        "vector_kwargs",
        "wrappers",
    }
)
# The one argument of gym.make, not of the constructor, that a sweep file may set.
_MAKE_ARGS = frozenset({"max_episode_steps"})


@dataclass(frozen=True)
class EnvInfo:
    """What is known of an environment before anything is trained on it."""

    env_id: str
    env_args: dict[str, Any] = field(hash=False)
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    threshold: float | None
    """Mean episode return from which it counts as solved; None if the env defines none."""
    max_episode_steps: int | None
    """Env steps after which an episode is truncated; None if it never is."""
    has_vector_entry_point: bool
    """Whether `make_vector_env` uses the env's own vectorised version."""


def normalize_env_id(env_id: str) -> str:
    """The registered id that a user's id means: `CartPole` is the newest `CartPole-v<n>`.

    Raises:
        EnvError: Not a string, empty, of the form `module:id`, or not registered.
    """
    if not isinstance(env_id, str) or not env_id.strip():
        raise EnvError(
            f"The env id is {env_id!r}, which names no environment.",
            "Give a Gymnasium id such as 'CartPole-v1'.",
        )
    env_id = env_id.strip()
    if ":" in env_id:
        raise EnvError(
            f"The env id {env_id!r} names a Python module to import; ids with a colon are refused, because "
            "importing the module would run its code.",
            "Install a package that registers the env with Gymnasium (entry point 'gymnasium.envs') and give "
            f"the registered id alone: {env_id.rpartition(':')[2]!r}.",
        )
    problems: tuple[str, ...] = ()
    found = _find_registered(env_id)
    if found is None:
        problems = load_env_plugins()
        found = _find_registered(env_id)
    if found is None:
        reasons = "".join(f" {problem}" for problem in problems)
        raise EnvError(
            f"No environment {env_id!r} is registered with Gymnasium.{_did_you_mean(env_id)}{reasons}",
            "Correct the id, or install the package that registers it.",
        )
    return found


def _find_registered(env_id: str) -> str | None:
    if env_id in gym.registry:
        return env_id
    try:
        namespace, name, version = parse_env_id(env_id)
        newest = find_highest_version(namespace, name) if version is None else None
    except gym.error.Error:  # of no form that an id can have
        return None
    return None if newest is None else get_env_id(namespace, name, newest)


def check_env(env_id: str, env_args: Mapping[str, Any] | None, algorithm: Algorithm | None = None) -> EnvInfo:
    """Make and reset an environment once and check that an algorithm can train on it.

    Args:
        env_id: Gymnasium id.
        env_args: Keyword arguments of its constructor; None: none.
        algorithm: Check the action space for this one; None: for any.

    Raises:
        EnvError: The id is not registered, an argument is wrong, the env cannot be made, or its spaces are of
            a kind that the algorithm cannot take.
    """
    env = make_env(env_id, env_args)
    try:
        spec = _registered(env_id)
        info = EnvInfo(
            env_id=spec.id,
            env_args=copy.deepcopy(dict(env_args or {})),
            observation_space=env.observation_space,
            action_space=env.action_space,
            threshold=None if spec.reward_threshold is None else float(spec.reward_threshold),
            max_episode_steps=None if env.spec is None else env.spec.max_episode_steps,
            has_vector_entry_point=_takes_vector_entry_point(spec, dict(env_args or {})),
        )
        _check_observation_space(info)
        _check_action_space(info, algorithm)
        _check_reset(env, info)
    finally:
        env.close()  # type: ignore[no-untyped-call]
    return info


def make_env(
    env_id: str, env_args: Mapping[str, Any] | None = None, *, render_mode: str | None = None
) -> gym.Env[Any, Any]:
    """Make one environment, with its time limit.

    Args:
        env_id: Gymnasium id.
        env_args: Keyword arguments of its constructor; None: none.
        render_mode: As Gymnasium's; None: no rendering.

    Raises:
        EnvError: The id is not registered, an argument is wrong, or the constructor failed.
    """
    spec = _registered(env_id)
    kwargs = copy.deepcopy(dict(env_args or {}))
    _check_args(spec, kwargs)
    if render_mode is not None:
        kwargs["render_mode"] = render_mode
    try:
        # The passive checker only prints warnings, at each env made, and slows every step.
        return gym.make(spec, disable_env_checker=True, **kwargs)
    except Exception as error:  # an env's constructor may raise anything
        raise _cannot_make(spec.id, env_args, error) from error


def make_vector_env(
    env_id: str, env_args: Mapping[str, Any] | None, num_envs: int
) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Make a vector environment: the env's own vectorised version if it has one, else a loop over envs.

    Both reset a sub-environment in the step after its episode ended (`AutoresetMode.NEXT_STEP`) and both have
    the env's time limit. Which one is made is `EnvInfo.has_vector_entry_point`.

    Args:
        env_id: Gymnasium id.
        env_args: Keyword arguments of its constructor; None: none.
        num_envs: Number of sub-environments.

    Raises:
        EnvError: As `make_env`.
    """
    spec = _registered(env_id)
    kwargs = copy.deepcopy(dict(env_args or {}))
    _check_args(spec, kwargs)
    try:
        if _takes_vector_entry_point(spec, kwargs):
            return gym.make_vec(spec, num_envs=num_envs, vectorization_mode="vector_entry_point", **kwargs)
        return gym.make_vec(spec, num_envs=num_envs, vectorization_mode="sync", disable_env_checker=True, **kwargs)
    except Exception as error:  # an env's constructor may raise anything
        raise _cannot_make(spec.id, env_args, error) from error


def _registered(env_id: str) -> EnvSpec:
    return gym.registry[normalize_env_id(env_id)]


def _did_you_mean(env_id: str) -> str:
    by_lower_case = {name.lower(): name for name in gym.registry}
    close = difflib.get_close_matches(env_id.lower(), by_lower_case, n=3, cutoff=0.7)
    names = [repr(by_lower_case[name]) for name in close]
    return f" Did you mean {' or '.join(names)}?" if names else ""


def _check_args(spec: EnvSpec, env_args: dict[str, Any]) -> None:
    """Refuse arguments that the constructor does not take, naming the nearest that it does."""
    creator: Callable[..., Any] | None = spec.entry_point if callable(spec.entry_point) else None
    if creator is None and isinstance(spec.entry_point, str):
        try:
            creator = load_env_creator(spec.entry_point)
        except Exception as error:  # importing an env's module may raise anything
            raise _cannot_make(spec.id, env_args, error) from error
    takes_any = creator is None
    known = set(_MAKE_ARGS)
    if creator is not None:
        parameters = inspect.signature(creator).parameters.values()
        takes_any = any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in parameters)
        known |= {p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}
    known -= _RESERVED_ARGS
    for name, value in env_args.items():
        if name in _RESERVED_ARGS:
            raise EnvError(
                f"The env argument {name!r} (value {value!r}) cannot be set: it is chosen where the env is used.",
                f"Remove {name!r} from the env's arguments.",
            )
        if name not in known and not takes_any:
            close = difflib.get_close_matches(str(name), known, n=1)
            did_you_mean = f" Did you mean {close[0]!r}?" if close else ""
            raise EnvError(
                f"{spec.id} takes no argument {name!r} (value {value!r}).{did_you_mean}",
                f"It takes: {', '.join(sorted(known))}.",
            )
    if "max_episode_steps" in env_args:
        _check_limit(spec.id, env_args["max_episode_steps"])


def _check_limit(env_id: str, limit: Any) -> None:
    if isinstance(limit, bool) or not isinstance(limit, int) or limit < 1:
        raise EnvError(
            f"The env argument 'max_episode_steps' of {env_id} is {limit!r}; it must be a whole number >= 1.",
            "Correct it, or leave it out to keep the env's own limit.",
        )


def _takes_vector_entry_point(spec: EnvSpec, env_args: dict[str, Any]) -> bool:
    """Whether the env has a vectorised version that accepts these arguments and the env's time limit."""
    # A vector entry point would leave out wrappers of the registry entry, and a time limit it does not take.
    if spec.vector_entry_point is None or spec.additional_wrappers:
        return False
    kwargs = {**spec.kwargs, **env_args}
    if spec.max_episode_steps is not None:
        kwargs.setdefault("max_episode_steps", spec.max_episode_steps)
    try:
        entry_point = spec.vector_entry_point
        creator = entry_point if callable(entry_point) else load_env_creator(entry_point)
        inspect.signature(creator).bind(num_envs=1, **kwargs)
    except (ImportError, AttributeError, TypeError, ValueError):
        return False
    return True


def _cannot_make(env_id: str, env_args: Mapping[str, Any] | None, error: Exception) -> EnvError:
    detail = str(error).strip().rstrip(".") or "no message"
    arguments = f" with arguments {dict(env_args)!r}" if env_args else ""
    message = f"The environment {env_id!r} cannot be made{arguments}: {type(error).__name__}: {detail}."
    if "box2d" in detail.lower():
        # gymnasium[box2d] asks for a source build; this wheel holds the same module.
        return EnvError(message, "Install it, on every machine that runs trials: pip install Box2D==2.3.10")
    if isinstance(error, (ImportError, gym.error.DependencyNotInstalled)):
        return EnvError(message, "Install the package that the message names, on every machine that runs trials.")
    return EnvError(message, "Check the env's arguments against its documentation.")


def _check_reset(env: gym.Env[Any, Any], info: EnvInfo) -> None:
    """Reset once: many envs look at the values of their arguments only then."""
    try:
        observation, _ = env.reset(seed=0)
        shape = np.shape(observation)
    except Exception as error:  # an env may raise anything
        raise EnvError(
            f"The environment {info.env_id!r} with arguments {info.env_args!r} cannot be reset: "
            f"{type(error).__name__}: {error}.",
            "Check the env's arguments, or mend its reset().",
        ) from error
    if shape != info.observation_space.shape:
        raise EnvError(
            f"{info.env_id} returns observations of shape {shape} but declares {info.observation_space.shape}.",
            "Mend the env: its observations must be of the shape of its observation_space.",
        )


def _check_observation_space(info: EnvInfo) -> None:
    space = info.observation_space
    if not isinstance(space, gym.spaces.Box):
        raise EnvError(
            f"{info.env_id} has observations of kind {type(space).__name__} ({space}); only 1-D Box "
            "observations are supported.",
            "Choose an env whose observations are a vector of numbers, such as 'CartPole-v1'.",
        )
    if len(space.shape) != 1 or space.shape[0] == 0:
        raise EnvError(
            f"{info.env_id} has observations of shape {space.shape}; only 1-D Box observations, of shape "
            "(n,), are supported.",
            "Choose an env whose observations are a vector of numbers; images need a convolutional network.",
        )
    if not np.issubdtype(space.dtype, np.floating):
        raise EnvError(
            f"{info.env_id} has observations of dtype {space.dtype}; only floating-point observations are supported.",
            "Register a variant of the env that returns float32 observations, scaled to about [-1, 1].",
        )


def _check_action_space(info: EnvInfo, algorithm: Algorithm | None) -> None:
    space = info.action_space
    if isinstance(space, gym.spaces.Discrete):
        return
    if not isinstance(space, gym.spaces.Box):
        raise EnvError(
            f"{info.env_id} has actions of kind {type(space).__name__} ({space}); only Discrete and 1-D Box "
            "actions are supported.",
            "Choose an env with Discrete or 1-D Box actions.",
        )
    if algorithm == "dqn":
        raise EnvError(
            f"DQN cannot train on {info.env_id}: its actions are continuous ({space}), and DQN needs Discrete ones.",
            "Use 'algorithm: ppo', or an env with Discrete actions.",
        )
    if len(space.shape) != 1 or space.shape[0] == 0 or not np.issubdtype(space.dtype, np.floating):
        raise EnvError(
            f"{info.env_id} has actions of shape {space.shape} and dtype {space.dtype}; only floating-point "
            "Box actions of shape (n,) are supported.",
            "Choose an env with Discrete or 1-D floating-point Box actions.",
        )

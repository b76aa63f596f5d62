"""The environment of a program for Stable-Baselines3 or RLlib: what registers it, and what makes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from policies.envs.atari import is_atari_id
from policies.envs.plugins import who_may_register
from policies.hyperparams import PPOHyperparams, TrainedHyperparams

NO_IMAGES = "The env's own observations are no images, as the convolutions need: wrap it."

_SCALED = """\
def scaled(config):
    env = MADE
    space = env.observation_space
    if space.dtype != numpy.uint8:
        return env
    largest = max(1, int(space.high.max()))
    numbers = gymnasium.spaces.Box(0, 1, space.shape)
    return TransformObservation(env, lambda image: numpy.float32(image) / largest, numbers)


register_env("scaled", scaled)"""
"""Code that registers an env whose images of bytes are of 0 to 1, as ours are seen (`scale_of_bytes`)."""


@dataclass(frozen=True)
class KnownEnv:
    """An environment that Gymnasium, or RLlib, knows once the lines were run."""

    env_id: str
    """The id by which it does."""
    imports: tuple[str, ...] = ()
    registration: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def known_env(env_id: str) -> KnownEnv:
    """Return an environment as Gymnasium knows it in a process that has imported nothing else.

    It knows no class that is written `module:Class`, as no version is in its name, and of no installed package.
    """
    module, colon, name = env_id.partition(":")
    if colon and name.isidentifier():
        own = f"{name}-v0"
        call = f"gymnasium.register({own!r}, lambda **args: {module}.{name}(**args))"
        return KnownEnv(own, ("import gymnasium", f"import {module}"), (call, ""))
    if colon:
        return KnownEnv(env_id)
    if is_atari_id(env_id):
        # Its package registers the games when it is imported; RLlib has a branch of its own for this form.
        return KnownEnv(f"ale_py:{env_id}")
    return _of_a_package(env_id)


def _of_a_package(env_id: str) -> KnownEnv:
    """Return an environment that the entry point of an installed package registers, if none other does."""
    imports, lines, packages = [], [], []
    found = who_may_register(env_id)
    for entry_point in found:
        # A package may name the file of its own module.
        module = entry_point.module.removesuffix(".__init__")
        imports.append(f"import {module}")
        call = f"{module}.{entry_point.attr}()"
        # The function leaves out the namespace that its entry point has as its name.
        lines += (
            [call] if entry_point.namespace is None else [f"with namespace({entry_point.namespace!r}):", f"    {call}"]
        )
        packages.append(entry_point.package)
    if any(entry_point.namespace is not None for entry_point in found):
        imports.append("from gymnasium.envs.registration import namespace")
    notes = []
    if len(found) > 1:
        notes.append(f"{env_id} is registered by one of {', '.join(packages)}: the others' lines can go.")
    return KnownEnv(env_id, tuple(dict.fromkeys(imports)), (*lines, "") if lines else (), tuple(notes))


@dataclass(frozen=True)
class MadeEnv:
    """The lines that make Stable-Baselines3's `env`."""

    imports: tuple[str, ...]
    lines: tuple[str, ...]
    notes: tuple[str, ...]


def sb3_env(values: TrainedHyperparams, env: KnownEnv, env_args: Mapping[str, Any], *, flattens: bool) -> MadeEnv:
    """Return what makes a setting's environments in Stable-Baselines3.

    Args:
        values: The setting.
        env: The environment.
        env_args: Its keyword arguments.
        flattens: Whether its own observations, neither vectors nor images, are to be made such.
    """
    imports, notes, wrapper = ["from stable_baselines3.common.env_util import make_vec_env"], [], ""
    if flattens and values.conv_filters is None:
        wrapper = ", wrapper_class=FlattenObservation"
        imports.insert(0, "from gymnasium.wrappers import FlattenObservation")
    elif flattens:
        notes += [NO_IMAGES, "If they are a Dict, MultiInputPolicy takes them, with convolutions of its own."]
    made = f"make_vec_env({env.env_id!r}, n_envs={values.num_envs}{wrapper}{env_kwargs('env_kwargs', env_args)})"
    lines = [f"env = {made}"]
    scales = isinstance(values, PPOHyperparams) and values.normalize_rewards
    normalizes = values.normalize_observations and values.conv_filters is None
    if values.normalize_observations and not normalizes:
        # Those that VecNormalize makes are no bytes.
        notes.append("normalize_observations is left out: CnnPolicy takes bytes.")
    if normalizes or scales:
        imports += ["from stable_baselines3.common.vec_env import VecNormalize"]
        norm_obs = "" if normalizes else ", norm_obs=False"
        norm_reward = f"gamma={values.gamma!r}" if scales else "norm_reward=False"
        lines += [f"env = VecNormalize(env{norm_obs}, {norm_reward})"]
    return MadeEnv(tuple(imports), tuple(lines), tuple(notes))


def rllib_env(values: TrainedHyperparams, env: KnownEnv, *, flattens: bool) -> KnownEnv:
    """Return a setting's environment as RLlib takes it, which has no argument for an env's wrapper.

    RLlib's layers take floating-point numbers alone, and it neither converts nor scales what an env observes.

    Args:
        values: The setting.
        env: The environment.
        flattens: Whether its own observations, neither vectors nor images, are to be made such.
    """
    has_images = values.conv_filters is not None
    if flattens and has_images:
        return replace(env, notes=(*env.notes, NO_IMAGES))
    if not flattens and not has_images:
        return env
    made = f"gymnasium.make({env.env_id!r}, **config)"
    if has_images:
        name, wrappers, lines = "scaled", "TransformObservation", _SCALED.replace("MADE", made)
    else:
        name, wrappers = "flattened", "DtypeObservation, FlattenObservation"
        wrapped = f"DtypeObservation(FlattenObservation({made}), numpy.float32)"
        lines = f'register_env("flattened", lambda config: {wrapped})'
    imports = (
        *dict.fromkeys([*env.imports, "import gymnasium"]),
        "import numpy",
        f"from gymnasium.wrappers import {wrappers}",
        "from ray.tune import register_env",
    )
    return KnownEnv(name, imports, (*env.registration, lines, ""), env.notes)


def env_kwargs(name: str, env_args: Mapping[str, Any]) -> str:
    """Return an environment's keyword arguments as one of a call's, after a comma; empty: it has none."""
    return f", {name}={dict(env_args)!r}" if env_args else ""

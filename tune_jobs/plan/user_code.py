"""Handle a user's own environment or RLModule in a sweep, passed to a Python call or named as `module:Name`.

Classes that a sweep file names are imported only from modules that were allowed (see `policies.envs.modules`). The code
of a class that is passed to a Python call runs in this process already, so passing it allows its module.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym

from policies.acting.baselines import BASELINES
from policies.envs.ids import module_of
from policies.envs.modules import allow_modules, import_allowed, path_of
from policies.errors import SpecError
from policies.networks.own_modules import ASKED, check_own_module
from tune_jobs.spec.domains import Listed
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec

Source = str | Path | Mapping[str, Any] | SweepSpec
"""A sweep file, a preset's name, a mapping with a sweep file's keys, or a spec."""


def load_source(source: Source, overrides: Sequence[str] = (), rl_module: type[Any] | str | None = None) -> SweepSpec:
    """Read and validate a sweep that was passed to a Python call, possibly with classes of the caller's own.

    Args:
        source: In a mapping, `env`, `env.id` and `rl_module` may be classes.
        overrides: The same as for `load_spec`.
        rl_module: An RLModule class, or `module:Class`, whose module is allowed by this; None: the source's.

    Raises:
        SpecError: The sweep is wrong, or a class is defined where other processes cannot find it.
    """
    if isinstance(source, SweepSpec):
        source = dict(source)
    if isinstance(source, Mapping):
        source = _with_names(source)
    if rl_module is not None:
        if isinstance(rl_module, str) and (module := module_of(rl_module)) is not None:
            allow_modules([module])
        named = rl_module if isinstance(rl_module, str) else path_of(rl_module, "RLModule")
        overrides = (*overrides, f"rl_module={named}")
    return load_spec(source, overrides)


def _with_names(source: Mapping[str, Any]) -> dict[str, Any]:
    named = dict(source)
    env = named.get("env")
    if isinstance(env, Mapping):
        named["env"] = {**env, "id": _env_name(env["id"])} if "id" in env else env
    else:
        named["env"] = _env_name(env)
    if isinstance(named.get("rl_module"), type):
        named["rl_module"] = path_of(named["rl_module"], "RLModule")
    return {key: value for key, value in named.items() if key in source}


def _env_name(env: Any) -> Any:
    """Return a class's name; other values are returned as they are, and checked as part of the spec."""
    if not isinstance(env, type):
        return env
    if not issubclass(env, gym.Env):
        raise SpecError(
            f"env is the class {env.__qualname__}, which is not a gymnasium.Env.",
            "Derive it from gymnasium.Env, or give a Gymnasium id such as 'CartPole-v1'.",
        )
    return path_of(env, "environment")


def modules_of(spec: SweepSpec) -> tuple[str, ...]:
    """Return the modules of a user's own that a sweep needs; `sweep.json` allows them for its trials."""
    return tuple(sorted({module for path in (spec.env.id, spec.rl_module or "") if (module := module_of(path))}))


def check_rl_module(spec: SweepSpec) -> None:
    """Check that a sweep's RLModule may be imported and is an RLModule class.

    Raises:
        SpecError: It is not allowed, not found, not an RLModule class, or none that the algorithm can train and that
            its hyperparameters reach; or the algorithm has no network.
    """
    if spec.rl_module is None:
        return
    if spec.algorithm in BASELINES:
        raise SpecError(
            f"rl_module is {spec.rl_module}, but algorithm {spec.algorithm} has no network.",
            "Leave rl_module out, or set algorithm to ppo or dqn.",
        )
    try:
        found = import_allowed(spec.rl_module)
    except SpecError as error:
        raise SpecError(f"rl_module is {spec.rl_module}. {error.message}", error.hint) from error
    # Checked by name, because importing RLlib takes seconds. RLlib's checkpoints need a class, not a factory function.
    bases = found.__mro__ if isinstance(found, type) else ()
    if not any(base.__name__ == "RLModule" and base.__module__.startswith("ray.rllib.") for base in bases):
        raise SpecError(
            f"rl_module is {spec.rl_module}, which is not an RLModule class but {found!r}.",
            "Derive it from RLlib's RLModule, or from one of policies.networks.",
        )
    check_own_module(spec.rl_module, found, spec.algorithm, {name: _asked(spec, name) for name in ASKED})


def _asked(spec: SweepSpec, name: str) -> Sequence[Any]:
    """Return what a sweep file asks of a hyperparameter: its values in the space, or the one that is fixed."""
    if (domain := spec.space.get(name)) is not None:
        return domain.values if isinstance(domain, Listed) else ()
    return [spec.hyperparams[name]] if name in spec.hyperparams else []

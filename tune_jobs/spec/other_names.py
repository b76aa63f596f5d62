"""What to write for a name that is no field where it stands: another place of it, or another tuner's name of a field.

By its letters alone Ray Tune's `training_iteration` is nearest to `training_return`, which ends trials at a return.
Names of hyperparameters are in `policies.foreign_names`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pydantic import BaseModel

from policies.foreign_names import FOREIGN_NAMES
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM
from tune_jobs.spec.sections import SweepFields

_FIXED_OR_SEARCHED = "values that are fixed go under hyperparams, and what is searched under space"
_NO_METRIC = "a setting is judged by its evaluation returns, higher is better; objective says how"
MEANT: Mapping[str, Mapping[str, str]] = {
    "": {
        "config": _FIXED_OR_SEARCHED,
        "direction": _NO_METRIC,
        "goal": _NO_METRIC,
        "max_concurrent_trials": "resources.max_concurrent",
        "method": "search",
        "metric": _NO_METRIC,
        "mode": _NO_METRIC,
        "n_jobs": "resources.max_concurrent",
        "n_seeds": "seeds_per_point",
        "n_startup_trials": "search.num_startup_trials",
        "n_trials": "num_samples",
        "num_seeds": "seeds_per_point",
        "num_trials": "num_samples",
        "param_space": "space",
        "parameters": "space",
        "pruner": "scheduler",
        "repetitions": "seeds_per_point",
        "run_cap": "num_samples",
        "sampler": "search",
        "search_alg": "search",
        "search_space": "space",
        "seeds": "seeds_per_point",
        "strategy": "search",
    },
    "search": {"n_startup_trials": "num_startup_trials", "startup_trials": "num_startup_trials"},
    "stop": {
        "episodes_total": "num_episodes",
        "max_iterations": "num_iterations",
        "max_t": "num_env_steps",
        "n_timesteps": "num_env_steps",
        "num_env_steps_sampled_lifetime": "num_env_steps",
        "time_total_s": "time_s",
        "timeout": "time_s",
        "timesteps_total": "num_env_steps",
        "total_timesteps": "num_env_steps",
        "training_iteration": "num_iterations",
        "training_iterations": "num_iterations",
    },
}
"""By section, what Ray Tune, Optuna, W&B, Katib and RL Zoo have: our field, or a sentence. Top-level: no section."""


def meant_by(location: Sequence[int | str], name: str) -> str:
    """Return what to write for a name, beginning with a space; empty: it is none that is known.

    Args:
        location: The section in which it stands; empty: the top level.
        name: The name, which is no field there.
    """
    section = ".".join(map(str, location))
    meant = MEANT.get(section, {}).get(name)
    if meant is not None:
        return f" {meant[0].upper()}{meant[1:]}." if " " in meant else f" Did you mean {meant!r}?"
    return place_of(name) or ("" if location else _hyperparam(name))


def place_of(name: str) -> str:
    """Return a hint for a field that exists in another section, beginning with a space; empty: in none."""
    places = _sections_with(name)
    if any(name in model.model_fields for model in HYPERPARAMS_BY_ALGORITHM.values()):
        places += [f"hyperparams.{name}", f"space.{name}"]
    return _or(places)


def section_of(name: str) -> str:
    """Return a hint for what is no hyperparameter, but a field of the sweep or of a section; see `place_of`."""
    if name in SweepFields.model_fields:
        return f" {name} is a field of the whole sweep: write it at the top level."
    return _or(_sections_with(name))


def _or(places: Sequence[str]) -> str:
    return f" Did you mean {' or '.join(places)}?" if places else ""


def _sections_with(name: str) -> list[str]:
    return [
        f"{section}.{name}"
        for section, field in SweepFields.model_fields.items()
        if section != "about"  # its strings are not settings
        and isinstance(field.annotation, type)
        and issubclass(field.annotation, BaseModel)
        and name in field.annotation.model_fields
    ]


def _hyperparam(name: str) -> str:
    """Return what another library's hyperparameter is here, for each algorithm that has it; see `meant_by`."""
    told: dict[str, list[str]] = {}
    for algorithm, names in FOREIGN_NAMES.items():
        for foreign in names:
            if foreign.name == name:
                of_library = f"{foreign.library}'s {name}"
                meant = " and ".join(f"hyperparams.{ours}" for ours in foreign.ours)
                text = f"{of_library} is {meant} here" if meant else f"For {of_library}, {foreign.difference}"
                told.setdefault(text, []).append(algorithm)
    if not told:
        return ""
    if len(told) == 1:
        return f" {next(iter(told))}; what is searched goes under space."
    each = "; ".join(f"{text} ({' and '.join(algorithms)})" for text, algorithms in told.items())
    return f" {each}; what is searched goes under space."

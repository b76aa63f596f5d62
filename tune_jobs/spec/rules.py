"""Find settings of a sweep that contradict each other, and why an engine can train none of its trials."""

from __future__ import annotations

from typing import TYPE_CHECKING

from analysis.records import TRAINING_LENGTH
from analysis.wording import counted
from policies.errors import SpecError
from policies.hyperparams import (
    HYPERPARAMS_BY_ALGORITHM,
    RandomHyperparams,
)
from tune_jobs.spec.domains import Grid, Range
from tune_jobs.spec.draws import num_points
from tune_jobs.spec.engines import Engine, Need
from tune_jobs.spec.scheduler import SMALLEST_SUBPOPULATION, num_worst

if TYPE_CHECKING:
    from tune_jobs.spec.sections import SweepFields

Found = list[tuple[str, str]]
"""Pairs of a dotted path in the sweep file and what is wrong there."""


FIXED_IN_A_POPULATION: frozenset[str] = frozenset(
    {
        # The network, or its running statistics, would differ from those that are copied.
        "hidden_sizes", "activation", "initializer", "conv_filters", "normalize_observations", "normalize_rewards",
        "vf_share_layers", "free_log_std", "dueling", "target_network",
        # The optimizer's state would differ from the one that is copied.
        "optimizer", "rmsprop_momentum",
        # What has been learned is of rewards times the other factor.
        "reward_scale",
        # The last target update is counted in it.
        "target_update_unit",
        # There would be other sub-environments, by which a trial's seeds are counted.
        "num_envs",
        # They act only at a trial's start.
        "kl_coeff", "learning_starts",
    }
)  # fmt: skip
"""Hyperparameters that can't change within a trial, or would have no effect."""


def search_problems(spec: SweepFields) -> Found:
    """Return what is wrong with a sweep's search method and scheduler."""
    found: Found = []
    if spec.search.has_model:
        found += _model_problems(spec)
    elif spec.prior:
        text = f"is for a search that learns, and search.type is {spec.search.type}: set search: auto, or leave it out"
        found.append(("prior", text))
    if twice := [sweep for index, sweep in enumerate(spec.prior) if sweep in spec.prior[:index]]:
        found.append(("prior", f"names {twice[0]!r} twice: name it once"))
    if spec.scheduler.waits_for_others and spec.resources.max_concurrent is not None:
        text = (
            f"{spec.resources.max_concurrent} cannot be used with scheduler.type {spec.scheduler.type}, which pauses "
            "trials until others have come as far: limit how many run by resources.num_cpus"
        )
        found.append(("resources.max_concurrent", text))
    if spec.scheduler.is_population:
        found += _population_problems(spec)
    elif spec.scheduler.perturb_every_env_steps is not None:
        text = f"is for pbt and pb2, but scheduler.type is {spec.scheduler.type}: leave it out, or set the type to pbt"
        found.append(("scheduler.perturb_every_env_steps", text))
    if len(spec.scheduler.frequencies) > 1:
        found += _frequency_problems(spec)
    return found + _cost_problems(spec)


def _cost_problems(spec: SweepFields) -> Found:
    if spec.objective.cost is None:
        return []
    if spec.objective.type == "steps_to_threshold":
        text = "cannot be used with steps_to_threshold, which counts env steps itself: use final, area or best"
        return [("objective.cost", text)]
    if spec.scheduler.is_population:
        why = "whose trials are no settings that could be set against a cost"
        return [("objective.cost", f"cannot be used with {spec.scheduler.type} (scheduler.type), {why}")]
    return []


_USED_BY: dict[str, dict[str, tuple[str, ...]]] = {
    "scheduler": {
        "grace_env_steps": ("asha", "hyperband", "median"),
        "reduction_factor": ("asha", "hyperband"),
        "quantile_fraction": ("pbt", "pb2"),
        "resample_probability": ("pbt", "pb2"),
    },
    "search": {"num_startup_trials": ("gp", "forest", "tpe")},
}
"""The types of search and scheduler that a field is for; `perturb_every_env_steps` is refused without pbt and pb2."""


def idle_settings(spec: SweepFields) -> list[str]:
    """Return the plan's notes on settings of search and scheduler that were changed but can't act."""
    notes = []
    for section, fields in _USED_BY.items():
        given = getattr(spec, section)
        for name, types in fields.items():
            if given.type not in types and getattr(given, name) != type(given).model_fields[name].default:
                notes.append(f"{section}.{name} can't act: {section}.type is {given.type}, not {' or '.join(types)}.")
    return notes + _cost_notes(spec) + _notes_without_settings(spec)


def _notes_without_settings(spec: SweepFields) -> list[str]:
    """Return the notes on what was changed of how settings are judged, in a population, which has none."""
    if not spec.scheduler.is_population:
        return []
    why = f"trials of a population (scheduler.type {spec.scheduler.type}) change their values while they train"
    objective, confirm, notes = spec.objective, spec.confirm, []
    if objective.type != type(objective)().type:
        notes.append(
            f"objective.type {objective.type} is for charts of the report alone: {why}, so that there are no "
            "settings to judge, and are compared by their evaluations."
        )
    if confirm.max_share > 0 and confirm != type(confirm)():
        notes.append(f"confirm can't act: {why}, so that there are no settings to train again.")
    return notes


def _cost_notes(spec: SweepFields) -> list[str]:
    """Return the note on a cost in which settings can't differ."""
    if spec.objective.cost is None:
        return []
    if TRAINING_LENGTH in spec.space or _differ_in_length(spec):
        return []
    # A scheduler that compares trials that have come equally far refuses lengths of their own.
    search = f"search their length, as in space: {{{TRAINING_LENGTH}: {{choice: [20_000, 50_000]}}}}, or "
    text = (
        "objective asks for env_steps, but all trainings are to be as long: "
        f"{'' if spec.scheduler.waits_for_others else search}end them at a goal (stop.training_return, "
        "stop.evaluation_return)."
    )
    return [text]


def _differ_in_length(spec: SweepFields) -> bool:
    """Whether trainings end where they don't all have as many env steps: at a goal, by time, or by another count."""
    stop = spec.stop
    if (stop.training_return, stop.evaluation_return, stop.num_episodes) != (None, None, None):
        return True
    fields = type(stop).model_fields
    if stop.time_s != fields["time_s"].default:
        return True
    is_capped = stop.num_iterations != fields["num_iterations"].default
    of_an_iteration = "train_batch_size" if spec.algorithm == "ppo" else "env_steps_per_iteration"
    return is_capped and of_an_iteration in spec.space


def check_extendable(spec: SweepFields, num_samples: int) -> None:
    """Check that so many more samples would be new points, and enough for the sub-populations if there are any.

    Raises:
        SpecError: The space has nothing random to draw, and no search method or scheduler chooses values; or there
            would be fewer trials than sub-populations need.
    """
    chosen = spec.search.has_model or spec.scheduler.is_population
    if not chosen and not any(domain.is_random for domain in spec.space.values()):
        why = "its space has only grids" if spec.space else "it has no space"
        raise SpecError(
            f"The sweep cannot be extended: {why}, so more samples would be the same points again.",
            "Launch a new sweep: with a larger seeds_per_point for more seeds, with more grid values for more points.",
        )
    number = len(spec.scheduler.frequencies)
    added = num_points(spec.space, spec.num_samples + num_samples) - num_points(spec.space, spec.num_samples)
    if number > 1 and added < SMALLEST_SUBPOPULATION * number:
        raise SpecError(
            f"The sweep cannot be extended by {counted(added, 'trial')}: they are compared with each other, in "
            f"{number} sub-populations (scheduler.frequencies), and each of these needs {SMALLEST_SUBPOPULATION}.",
            f"Add at least {SMALLEST_SUBPOPULATION * number} trials.",
        )


def check_replicable(spec: SweepFields) -> None:
    """Check that the sweep's points can be trained again with other seeds.

    Raises:
        SpecError: Trials of a population change their values while they train.
    """
    if spec.scheduler.is_population:
        raise SpecError(
            f"The sweep cannot be replicated: with population based training (scheduler.type {spec.scheduler.type}) a "
            "trial's values change while it trains, so that none of them is a setting that could be trained again.",
            "Launch a sweep of the values that the best trial ended with, fixed, with a larger seeds_per_point.",
        )


def check_takes_points(spec: SweepFields) -> None:
    """Check that points that somebody chooses can be added to the sweep.

    Raises:
        SpecError: Nothing is searched, or trials of a population change their values while they train.
    """
    if not spec.space:
        raise SpecError(
            "No point can be added to the sweep: it has no space, so that all its trials have the same values.",
            "Launch a new sweep with other values under hyperparams.",
        )
    if spec.scheduler.is_population:
        raise SpecError(
            "No point can be added to the sweep: with population based training (scheduler.type "
            f"{spec.scheduler.type}) a trial goes on "
            "from others' copies with other values, so that the point would not be trained as it was given.",
            "Launch a sweep of these values, fixed under hyperparams; `tune-jobs extend` adds trials to a population.",
        )


def _model_problems(spec: SweepFields) -> Found:
    method = spec.search.type
    if is_baseline(spec):
        return [("search.type", f"{method} needs an algorithm that learns, and {spec.algorithm} does not: use random")]
    found: Found = []
    if not spec.space:
        found.append(("search.type", f"{method} has nothing to search: space is empty"))
    if spec.scheduler.waits_for_others:
        kind = spec.scheduler.type
        why = f"waits for whole groups of trials, {method} starts one after another: use asha"
        if spec.scheduler.is_population:
            why = f"changes the values that {method} would learn from: use search.type random"
        found.append(("search.type", f"{method} cannot be used with scheduler.type {kind}: {kind} {why}"))
    if spec.space and not spec.prior and spec.num_samples <= spec.search.num_startup_trials:
        text = (
            f"{spec.num_samples} is not more than search.num_startup_trials, {spec.search.num_startup_trials}: all "
            f"points would be random. With {method}, num_samples is the number of points, and grids are lists to "
            "choose from"
        )
        found.append(("num_samples", text))
    return found


def _population_problems(spec: SweepFields) -> Found:
    found: Found = []
    kind = spec.scheduler.type
    if is_baseline(spec):
        return [("scheduler.type", f"{kind} needs an algorithm that learns, and {spec.algorithm} does not")]
    if not spec.space:
        found.append(("scheduler.type", f"{kind} has nothing to change: space is empty"))
    elif kind == "pb2" and not any(isinstance(domain, Range) for domain in spec.space.values()):
        text = "pb2 chooses values within ranges, and space has lists alone, which it changes as pbt does: use pbt"
        found.append(("scheduler.type", text))
    for name in spec.space:
        if name in FIXED_IN_A_POPULATION:
            text = (
                f"can't be changed within a trial, which {kind} (scheduler.type) would do: fix {name} under "
                "hyperparams, or use another scheduler"
            )
            found.append((f"space.{name}", text))
    size = num_points(spec.space, spec.num_samples)
    if spec.space and size < 2:
        name = "num_samples" if not any(isinstance(domain, Grid) for domain in spec.space.values()) else "space"
        found.append((name, f"gives {size} trial, and {kind} (scheduler.type) compares at least 2"))
    if spec.seeds_per_point > 1:
        text = (
            f"{spec.seeds_per_point} cannot be used with {kind}, which gives each trial its own values: raise "
            "num_samples"
        )
        found.append(("seeds_per_point", text))
    if spec.perturb_every_env_steps >= spec.stop.num_env_steps:
        text = (
            f"{spec.perturb_every_env_steps} is not less than stop.num_env_steps, {spec.stop.num_env_steps}: "
            "no trial would ever be changed"
        )
        found.append(("scheduler.perturb_every_env_steps", text))
    return found


def _frequency_problems(spec: SweepFields) -> Found:
    """Return what is wrong with several sub-populations."""
    given, fraction, kind = spec.scheduler.frequencies, spec.scheduler.quantile_fraction, spec.scheduler.type
    path, number, num_trials = "scheduler.frequencies", len(given), num_points(spec.space, spec.num_samples)
    if kind != "pbt":
        return [(path, f"is for pbt, but scheduler.type is {kind}: leave it out, or set the type to pbt")]
    found: Found = []
    sizes = (num_trials // number, -(-num_trials // number))
    if sizes[0] < SMALLEST_SUBPOPULATION:
        text = (
            f"gives {number} sub-populations, each of which needs at least {SMALLEST_SUBPOPULATION} trials, and there "
            f"would be {num_trials}: have at least {SMALLEST_SUBPOPULATION * number}, or fewer frequencies"
        )
        found.append((path, text))
    elif any(size <= 2 * num_worst(size, fraction) for size in sizes):
        text = (
            f"{fraction:g} leaves no trial of a sub-population of {sizes[0]} between the worst and the best, to "
            "take in one of another: lower it, or have more trials"
        )
        found.append(("scheduler.quantile_fraction", text))
    every, cap = spec.perturb_every_env_steps, spec.stop.num_env_steps
    if every < cap <= given[-1] * every:
        text = (
            f"{given[-1]} times scheduler.perturb_every_env_steps, {every:,}, is {given[-1] * every:,} env steps, "
            f"not less than stop.num_env_steps, {cap:,}: trials of this sub-population would never be compared"
        )
        found.append((path, text))
    return found


def needs_of(spec: SweepFields) -> dict[Need, str]:
    """Return what a sweep needs from its engine, as far as its file tells, each with the setting that needs it."""
    runners = spec.resources.num_env_runners
    found: dict[Need, tuple[bool, str]] = {
        "rl_module": (spec.rl_module is not None, f"rl_module is {spec.rl_module}"),
        "convolutions": (
            spec.env.pixels or spec.env.atari is not None,
            "env.pixels is true" if spec.env.atari is None else "env.atari is set",
        ),
        "env_runners": (runners > 0, f"resources.num_env_runners is {runners}"),
        "copies": (spec.scheduler.is_population, f"scheduler.type is {spec.scheduler.type}"),
        "pauses": (spec.scheduler.type == "hyperband", "scheduler.type is hyperband"),
    }
    return {need: setting for need, (is_needed, setting) in found.items() if is_needed}


def env_problems(spec: SweepFields) -> Found:
    """Return what is wrong with the wrappers of a sweep's environment."""
    if spec.env.atari is None:
        return []
    found: Found = []
    if spec.env.pixels:
        found.append(("env.pixels", "true cannot be used with env.atari, which observes images already: leave it out"))
    if spec.env.failure_penalty is not None:
        text = (
            f"{spec.env.failure_penalty:g} cannot be used with env.atari, whose lost lives are ends without a penalty"
        )
        found.append(("env.failure_penalty", f"{text}: leave it out"))
    if spec.env.own_process:
        text = "true cannot be used with env.atari, whose games read their emulator's memory: leave it out"
        found.append(("env.own_process", text))
    return found


def why_none(engine: Engine, spec: SweepFields) -> str | None:
    """Return why an engine can train no trial of a sweep, as far as its file tells, or None."""
    if spec.algorithm not in engine.algorithms:
        which = ", which does not learn" if is_baseline(spec) else ""
        return f"algorithm is {spec.algorithm}{which}"
    reasons = (engine.why_not(need, setting) for need, setting in needs_of(spec).items())
    return next((reason for reason in reasons if reason is not None), None)


def is_baseline(spec: SweepFields) -> bool:
    """Whether a sweep's algorithm is a baseline, which does not learn."""
    return issubclass(HYPERPARAMS_BY_ALGORITHM[spec.algorithm], RandomHyperparams)

"""Print the plan of a sweep, for dry runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from analysis.points import searched_names, value_text
from analysis.records import TRAINING_LENGTH
from analysis.wording import bytes_text, counted
from tune_jobs.cli.output import make_console, make_table, print_facts, print_json, span
from tune_jobs.cli.whole_columns import print_whole
from tune_jobs.search.startup import most_needed
from tune_jobs.search.subpopulations import subpopulation_of
from tune_jobs.spec.training_length import ends_of

if TYPE_CHECKING:
    from rich.table import Table

    from analysis.racing import Race
    from tune_jobs.plan.sweep_plan import SweepPlan
    from tune_jobs.spec.sweep_spec import SweepSpec

_MAX_TRIALS_SHOWN = 24


def show_plan(spec: SweepSpec, plan: SweepPlan, *, as_json: bool, finish: bool = True) -> None:
    """Print the plan of a sweep.

    Args:
        spec: The sweep.
        plan: Its plan.
        as_json: Whether to print it as JSON.
        finish: Whether anything follows the trials.
    """
    if as_json:
        print_json({"spec": spec.model_dump(mode="json"), "plan": plan.to_json()})
        return
    console = make_console()
    print_facts(console, _plan_facts(spec, plan, finish=finish))
    for note in (*plan.notes, *(plan.packs.notes if plan.packs is not None else ())):
        console.print(f"note: {note}", style="yellow")
    print_whole(console, _plan_table(spec, plan))
    hidden = len(plan.trials) - _MAX_TRIALS_SHOWN
    if hidden > 0:
        console.print(f"and {hidden:,} more; --json lists them all")
    console.print("Nothing was started: this was a dry run.", style="dim")


def _plan_facts(spec: SweepSpec, plan: SweepPlan, *, finish: bool) -> dict[str, str]:
    from tune_jobs.sweeps.confirm import largest_race

    machine, stop, race = plan.machine, spec.stop, largest_race(spec, plan.num_points) if finish else None
    returns = {"training return": stop.training_return, "evaluation return": stop.evaluation_return}
    rules = [f"{name} {value:g}" for name, value in returns.items() if value is not None]
    rules += [] if stop.num_episodes is None else [counted(stop.num_episodes, "episode")]
    rules += [
        _length_rule(spec),
        counted(stop.num_iterations, "iteration"),
        f"{stop.time_s:g} s",
    ]
    threshold = "" if plan.env.threshold is None else f" (solved at {plan.env.threshold:g})"
    points = counted(plan.num_points, "point")
    has = _resources(machine.num_cpus, machine.num_gpus)
    return {
        "environment": f"{plan.env.env_id}{threshold}",
        "algorithm": spec.algorithm,
        "trials": f"{len(plan.trials):,}: {points}, {counted(spec.seeds_per_point, 'seed')} each",
        "engine": _engine_fact(plan),
        "at once": f"{_at_once(plan)}; {machine.source} has {has}",
        "a trial stops at": " or ".join(rules),
        "search": search_fact(spec, plan.max_concurrent if plan.packs is None else plan.packs.max_concurrent),
        "scheduler": _scheduler_fact(spec),
        "then": _confirm_fact(race) if finish else "nothing (--no-finish)",
        "env steps": _env_steps_fact(plan, race),
        "disk": f"at most about {bytes_text(_disk_bytes(plan, race))}",
        "seeds": f"sweep {spec.seed}; evaluation {span(plan.evaluation_seeds)}; "
        f"confirmation {span(plan.confirmation_seeds)}",
    }


def _length_rule(spec: SweepSpec) -> str:
    domain = spec.space.get(TRAINING_LENGTH)
    ends = None if domain is None else ends_of(domain)
    if ends is None or ends[0] == ends[1]:
        return counted(spec.stop.num_env_steps, "env step")
    return f"{ends[0]:,} to {counted(ends[1], 'env step')} (searched)"


def _engine_fact(plan: SweepPlan) -> str:
    counts = plan.engines
    told = next(iter(counts)) if len(counts) == 1 else ", ".join(f"{name} {count:,}" for name, count in counts.items())
    packs = plan.packs
    if packs is None:
        return told
    kind = (
        f"{counted(packs.num_env_processes, 'process', 'processes')} per pack"
        if packs.num_env_processes
        else packs.env_kind
    )
    if packs.env_kind == "vectorised" and packs.env_step_us is not None:
        return f"{told}; environments: {kind}, {packs.env_step_us:.3g} us per step"
    return f"{told}; environments: {kind}" + (f" ({packs.why_env_kind})" if packs.why_env_kind else "")


def _at_once(plan: SweepPlan) -> str:
    packs = plan.packs
    if packs is None:
        return f"{plan.max_concurrent}, each on {_resources(plan.cpus_per_trial, plan.gpus_per_trial)}"
    each = _resources(packs.cpus_per_pack, packs.gpus_per_pack)
    trials = f"{packs.max_concurrent} in {counted(packs.num_packs, 'pack')} of up to {packs.slots}"
    return f"{trials}, each pack on {each}"


def _resources(cpus: float, gpus: float) -> str:
    return f"{cpus:g} CPU{'s' * (cpus > 1)}" + (f" and {gpus:g} GPU{'s' * (gpus > 1)}" if gpus else "")


def search_fact(spec: SweepSpec, at_once: int) -> str:
    """Return what a plan says of how points are chosen.

    Args:
        spec: The sweep.
        at_once: How many trials run at once.
    """
    if not spec.search.has_model:
        return "random draws for each combination of the grids"
    wanted, ended = spec.search.num_startup_trials, ", those of prior among them" if spec.prior else ""
    # One place is free when a point is chosen.
    running = -(-at_once // spec.seeds_per_point) - 1
    if spec.scheduler.type != "none" and (most := most_needed(wanted, spec.num_samples, running)) > wanted:
        ended += f", or fewer that were trained for as long as {wanted} whole ones"
        wanted = most
    return f"{spec.search.type}: its model proposes points once {wanted} have ended{ended}"


def _scheduler_fact(spec: SweepSpec) -> str:
    every = _selects_every(spec)
    if len(every) == 1:
        return spec.scheduler.type
    listed = f"{', '.join(every[:-1])} and {every[-1]}"
    return f"{spec.scheduler.type}, {len(every)} sub-populations that select every {listed} env steps"


def _selects_every(spec: SweepSpec) -> list[str]:
    """Return after how many env steps each sub-population selects; one text if there is but one."""
    return [f"{times * spec.perturb_every_env_steps:,}" for times in spec.scheduler.frequencies]


def _confirm_fact(race: Race | None) -> str:
    if race is None:
        return "no setting is trained again"
    trials = counted(race.max_trainings, "trial")
    return f"the {len(race.contenders)} leading settings get more seeds: at most {trials} (confirm: none leaves it out)"


def _env_steps_fact(plan: SweepPlan, race: Race | None) -> str:
    told = f"at most {plan.max_env_steps:,}"
    if race is None:
        return f"{told} in all"
    return f"{told}, and {race.max_trainings * plan.max_env_steps_per_trial:,} of more seeds"


def _disk_bytes(plan: SweepPlan, race: Race | None) -> int:
    """Return the most that the sweep's folder will hold, with the trials of more seeds like the others."""
    more = 0 if race is None else race.max_trainings
    return plan.max_disk_bytes * (len(plan.trials) + more) // max(1, len(plan.trials))


def _plan_table(spec: SweepSpec, plan: SweepPlan) -> Table:
    points: list[Mapping[str, Any]] = [trial.point for trial in plan.trials]
    if not all(points):
        # What acts in none of the known points may act in one that the model chooses.
        points.append(spec.space)
    names = searched_names(points)
    engines_differ = len(plan.engines) > 1
    every = _selects_every(spec)
    more = [*(["engine"] if engines_differ else []), *(["selects every"] if len(every) > 1 else [])]
    table = make_table("trial", "seed", *names, *more)
    for trial in plan.trials[:_MAX_TRIALS_SHOWN]:
        values = [value_text(trial.point, name, none=f"by {spec.search.type}") for name in names]
        told = [trial.engine] if engines_differ else []
        told += [every[subpopulation_of(trial.index, len(every))]] if len(every) > 1 else []
        table.add_row(trial.trial_id, str(trial.seed), *values, *told)
    return table

"""Plan a sweep before anything starts: trials, seeds, resources, and upper bounds of env steps and disk space.

A plan depends only on the sweep and the machine, and its trials only on the sweep: planning the same sweep with more
samples gives the same trials first. A sweep that can't run is refused here, with the numbers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Self, TypeVar

import gymnasium as gym
from pydantic import TypeAdapter

from analysis.numbering import planned_places
from analysis.records import FINISHED, ChosenPointRecord, PriorRecord, ReplicationRecord, TrialPlan, TrialRecord
from analysis.wording import counted
from policies.envs.make import EnvInfo
from policies.errors import MALFORMED, CannotRunError, SpecError, said_by
from policies.guard.guard import guarding
from policies.guard.guarded import check_env
from policies.hyperparams import Hyperparams
from tune_jobs.plan.comparison_notes import comparison_notes
from tune_jobs.plan.concurrency import max_concurrent
from tune_jobs.plan.engine_choice import PackPlan, choose_engines, pack_key
from tune_jobs.plan.env_checks import check_env_args, check_env_rules
from tune_jobs.plan.env_notes import env_notes
from tune_jobs.plan.estimates import max_disk_bytes, max_env_steps, trial_bytes
from tune_jobs.plan.idle_notes import idle_notes
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.memory import cpus_that_hold, lowered_by_memory
from tune_jobs.plan.pack_plan import TrialToPack, plan_packs
from tune_jobs.plan.points import (
    num_points_of,
    num_trials_of,
    place_of_point,
    point_hyperparams,
    repeated_points_notes,
    trial_id,
)
from tune_jobs.plan.user_code import check_rl_module
from tune_jobs.search.chosen_point import outside_notes
from tune_jobs.search.given_points import given_points, repeated_notes
from tune_jobs.search.points import largest_hyperparams, planned_points
from tune_jobs.search.prior import prior_notes
from tune_jobs.search.proposal import check_installed
from tune_jobs.spec.draws import MOST_COMBINATIONS
from tune_jobs.spec.engines import engine_named
from tune_jobs.spec.hyperparam_problems import check_distinct
from tune_jobs.spec.rules import idle_settings
from tune_jobs.spec.seeds import confirmation_seeds, evaluation_seeds, trial_seeds
from tune_jobs.spec.sweep_spec import SweepSpec, check_trainable
from tune_jobs.spec.training_length import as_trained

NUM_CONFIRMATION_EPISODES = 100
MAX_TRIALS = 100_000

# The size of what is made once per sweep, rounded up: videos, report, Ray Tune's own state.
_SWEEP_BYTES = 20_000_000

_Point = tuple[dict[str, Any] | None, Hyperparams | None]
"""The sampled values and all hyperparameters; both are None if the search method chooses them at the trial's start."""
_Own = TypeVar("_Own")


@dataclass(frozen=True)
class SweepPlan:
    """Everything a sweep will do."""

    trials: tuple[TrialPlan, ...]
    num_points: int
    cpus_per_trial: int
    gpus_per_trial: float
    max_concurrent: int
    """How many trials run at once, including those in packs."""
    max_concurrent_alone: int
    """How many of those in processes of their own run at once; packs are done before they begin."""
    evaluation_seeds: tuple[int, ...]
    confirmation_seeds: tuple[int, ...]
    max_env_steps: int
    """Upper bound of the env steps of all these trials without retries and evaluation episodes."""
    max_disk_bytes: int
    """Estimate of the most bytes that the sweep folder will hold."""
    env: EnvInfo
    machine: Machine
    notes: tuple[str, ...] = ()
    """Notes on settings that may not be meant, and on trials that are not packed."""
    prior: tuple[PriorRecord, ...] = ()
    """What the search of a new sweep begins with, of earlier sweeps."""
    max_env_steps_per_trial: int = 0
    """The same of the trial for which it is highest; those that `confirm` adds are no longer."""
    packs: PackPlan | None = None
    """The packs of the packed trials that have not ended; None: there are none."""

    def with_notes(self, notes: Sequence[str]) -> Self:
        """Return the plan with more notes."""
        return replace(self, notes=(*self.notes, *notes))

    @property
    def engines(self) -> dict[str, int]:
        """The number of trials by engine."""
        return dict(Counter(trial.engine for trial in self.trials))

    def to_json(self) -> dict[str, Any]:
        """Return the plan as JSON-like data, without the environment's spaces."""
        apart = ("trials", "env", "machine", "packs", "prior")
        data = {name: value for name, value in vars(self).items() if name not in apart}
        env = {"id": self.env.env_id, "args": self.env.env_args, "threshold": self.env.threshold}
        return data | {
            "num_trials": len(self.trials),
            "trials": [trial.model_dump(exclude={"changes"}) for trial in self.trials],
            "env": env,
            "machine": asdict(self.machine),
            "engines": self.engines,
            "packs": None if self.packs is None else asdict(self.packs),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the plan that such data was made of; what it leaves out of the environment is not known any more.

        Raises:
            CannotRunError: It is no such data, or another version's.
        """
        simple = (
            "num_points", "cpus_per_trial", "gpus_per_trial", "max_concurrent", "max_env_steps", "max_disk_bytes",
            "max_env_steps_per_trial",
        )  # fmt: skip
        unknown: gym.Space[Any] = gym.Space()
        try:
            env, packs = data["env"], data["packs"]
            return cls(
                trials=tuple(TrialPlan.model_validate(trial) for trial in data["trials"]),
                evaluation_seeds=tuple(data["evaluation_seeds"]),
                confirmation_seeds=tuple(data["confirmation_seeds"]),
                env=EnvInfo(
                    env["id"], env["args"], unknown, unknown, env["threshold"], None, has_vector_entry_point=False
                ),
                machine=TypeAdapter(Machine).validate_python(data["machine"]),
                notes=tuple(data["notes"]),
                packs=None if packs is None else _stored_packs(packs),
                # A plan of an older service has no such number.
                max_concurrent_alone=data.get("max_concurrent_alone", data["max_concurrent"]),
                **{name: data[name] for name in simple},
            )
        except MALFORMED as error:
            raise CannotRunError(
                f"This is no plan that this tune-jobs knows: {said_by(error)[:200]}.", "Is it of another version?"
            ) from error


def _stored_packs(data: Mapping[str, Any]) -> PackPlan:
    known: dict[str, Any] = {field.name: data[field.name] for field in fields(PackPlan) if field.name in data}
    return PackPlan(**known | {name: tuple(known[name]) for name in ("trial_ids", "notes")})


@guarding()
def make_plan(
    spec: SweepSpec,
    machine: Machine,
    records: Sequence[TrialRecord] = (),
    *,
    replications: Sequence[ReplicationRecord] = (),
    chosen_points: Sequence[ChosenPointRecord] | None = None,
    prior: Sequence[PriorRecord] = (),
    retry_failed: bool = False,
) -> SweepPlan:
    """Plan a sweep for a machine.

    Args:
        spec: The sweep.
        machine: What it runs on.
        records: The records of trials that exist already, which keep their engines.
        replications: More seeds of some points, oldest first.
        chosen_points: Points that somebody chose, oldest first; None: those of the sweep file, as for a new sweep.
        prior: What the search of a new sweep begins with.
        retry_failed: Whether the failed ones of them run again.

    Raises:
        EnvError: The environment isn't registered, can't be made, or doesn't fit the algorithm.
        SpecError: A point of the sweep file is wrong, values contradict each other or the environment, there are too
            many trials, a class is in a module that is not allowed, trials can't be packed though the sweep asks for
            it, or a new sweep searches a hyperparameter that can't act, or lists one value in two forms.
        CannotRunError: One trial needs more than the machine has, or the search method is not installed.
    """
    check_installed(spec.search.type)
    if chosen_points is None:
        chosen_points = given_points(spec)
    if not records:
        check_distinct(spec.algorithm, spec.space)
    check_env_args(spec)
    env = check_env(spec.env.id, spec.env.wrapped_args, spec.algorithm, timeout_s=spec.iteration_timeout_s)
    check_rl_module(spec)
    concurrent = max_concurrent(spec, machine, _num_trials(spec, replications, chosen_points))
    points = _points(spec, chosen_points, replications)
    known = [values for _, values in points if values is not None]
    check_env_rules(spec, env, known)
    trials, engine_notes = _trials(spec, env, points, records, replications)
    are_packed = [_is_packed(trial) for trial in trials if trial.seed_index == 0]
    searched = [point for point, _ in points]
    specs = [as_trained(spec, point or {}) for point in searched]
    idle = idle_notes(spec, env, [values for _, values in points], are_packed, searched, may_refuse=not records)
    sizes = _sizes(spec, points, known)
    to_run = _to_run(trials, records, retry_failed=retry_failed)
    if to_run:
        check_trainable(spec)
    lengths = _largest(sizes, specs, max_env_steps)
    memory = _largest(sizes, lengths, lambda most_steps, each: trial_bytes(env, each, most_steps))
    members = _members(to_run, points, memory)
    alone = [memory[trial.point_index] for trial in to_run if not _is_packed(trial)]
    cpus, waits, most = spec.cpus_per_trial, spec.scheduler.waits_for_others, concurrent
    concurrent, memory_notes = lowered_by_memory(
        machine,
        max(alone, default=0),
        concurrent,
        cpus=float(cpus),
        algorithm=spec.algorithm,
        num_processes=1 + spec.resources.num_env_runners if alone else 0,
        by_cpus=waits,
    )
    cpus = max(cpus, cpus_that_hold(machine, concurrent)) if waits and concurrent < most else cpus
    at_once = concurrent
    packs = plan_packs(spec, machine, members, may_spread=len(members) == len(to_run)) if members else None
    if packs is not None:
        all_are_packed = all(map(_is_packed, trials))
        concurrent = packs.max_concurrent if all_are_packed else max(packs.max_concurrent, concurrent)
    return SweepPlan(
        trials=trials,
        num_points=len(points),
        cpus_per_trial=cpus,
        gpus_per_trial=spec.resources.num_gpus,
        max_concurrent=concurrent,
        max_concurrent_alone=at_once,
        evaluation_seeds=evaluation_seeds(spec.seed, spec.evaluation.num_episodes),
        confirmation_seeds=confirmation_seeds(spec.seed, NUM_CONFIRMATION_EPISODES),
        max_env_steps=_total(trials, lengths),
        max_env_steps_per_trial=max(lengths, default=0),
        max_disk_bytes=_SWEEP_BYTES
        + _total(trials, _largest(sizes, specs, lambda own, each: max_disk_bytes(own, env, each))),
        env=env,
        machine=machine,
        notes=(
            *_notes(spec, env, packs, concurrent),
            *idle_settings(spec),
            *comparison_notes(spec, ((own, each) for own, values in zip(specs, sizes, strict=True) for each in values)),
            *idle,
            *engine_notes,
            *memory_notes,
            *outside_notes(spec, chosen_points),
            *repeated_notes(chosen_points, searched),
            *prior_notes(spec, prior, env.env_id),
        ),
        packs=packs,
        prior=tuple(prior),
    )


def _num_trials(
    spec: SweepSpec, replications: Sequence[ReplicationRecord], chosen_points: Sequence[ChosenPointRecord]
) -> int:
    """Return the number of trials to be planned; too many are refused."""
    number = num_trials_of(spec, replications, chosen_points)
    if number > MAX_TRIALS:
        # With conditions, combinations are counted up to a million and somewhat beyond.
        is_counted = number <= MOST_COMBINATIONS or not any(domain.when for domain in spec.space.values())
        told = f"{number:,}" if is_counted else f"more than {MOST_COMBINATIONS:,}"
        raise SpecError(
            f"The sweep has {told} trials; at most {MAX_TRIALS:,} can be planned.",
            "Lower num_samples or seeds_per_point, or make the grids smaller.",
        )
    return number


def _points(
    spec: SweepSpec, chosen_points: Sequence[ChosenPointRecord], replications: Sequence[ReplicationRecord]
) -> list[_Point]:
    """Return each point with all its hyperparameters."""
    return [
        (None, None) if point is None else (point, point_hyperparams(spec, point, index, replications))
        for index, point in enumerate(planned_points(spec, chosen_points))
    ]


def _trials(
    spec: SweepSpec,
    env: EnvInfo,
    points: Sequence[_Point],
    records: Sequence[TrialRecord],
    replications: Sequence[ReplicationRecord],
) -> tuple[tuple[TrialPlan, ...], tuple[str, ...]]:
    """Return the trials, and the notes on their engines."""
    numbered = planned_places(len(points), spec.seeds_per_point, replications)
    seeds = trial_seeds(spec.seed, len(numbered))
    dumped = [{} if values is None else values.model_dump(mode="json") for _, values in points]
    chosen = {record.point_index: record for record in records if record.has_point}
    trials: list[TrialPlan] = []
    for index, (point_index, seed_index) in enumerate(numbered):
        point, hyperparams = points[point_index][0], dumped[point_index]
        if point is None and seed_index >= spec.seeds_per_point and point_index in chosen:
            # More seeds of a point that the search method has chosen meanwhile.
            point, hyperparams = chosen[point_index].point, chosen[point_index].hyperparams
        trials.append(
            TrialPlan(
                trial_id=trial_id(index),
                index=index,
                point_index=point_index,
                seed_index=seed_index,
                seed=seeds[index],
                point=point or {},
                hyperparams=hyperparams,
                has_point=point is not None,
            )
        )
    choice = choose_engines(
        spec,
        env,
        [(trial.trial_id, points[trial.point_index][1]) for trial in trials],
        {record.trial_id: record.engine for record in records},
        lambda index: place_of_point(
            spec, points[trials[index].point_index][0], trials[index].point_index, replications
        ),
    )
    planned = (
        trial.model_copy(update={"engine": engine}) for trial, engine in zip(trials, choice.engines, strict=True)
    )
    return tuple(planned), choice.notes


def _to_run(trials: Sequence[TrialPlan], records: Sequence[TrialRecord], *, retry_failed: bool) -> list[TrialPlan]:
    """Return the trials that have not ended, and those that failed where they run again."""
    ended = {
        record.trial_id
        for record in records
        if record.status in FINISHED and not (retry_failed and record.status == "failed")
    }
    return [trial for trial in trials if trial.trial_id not in ended]


def _is_packed(trial: TrialPlan) -> bool:
    """Whether a pack trains a trial together with others."""
    return engine_named(trial.engine).trains_many


def _members(to_run: Sequence[TrialPlan], points: Sequence[_Point], memory: Sequence[float]) -> list[TrialToPack]:
    """Return the trials that are packed; `memory` is the memory of a trial of each point."""
    members = []
    # Points that are chosen later have equally many sub-environments as the others, or the number is not known.
    fewest_known = min((values.num_envs for _, values in points if values is not None), default=1)
    for trial in to_run:
        if _is_packed(trial):
            values = points[trial.point_index][1]
            key = None if values is None else pack_key(values)
            fewest = fewest_known if values is None else values.num_envs
            members.append(TrialToPack(trial.trial_id, key, memory[trial.point_index], fewest))
    return members


def _sizes(spec: SweepSpec, points: Sequence[_Point], known: list[Hyperparams]) -> list[list[Hyperparams]]:
    """Return, for each point, the hyperparameters that its largest trials may have."""
    if spec.scheduler.is_population:
        return [[values, *largest_hyperparams(spec, known)] for values in known]
    # One list for all points that are not known: `_largest` measures it once.
    largest = largest_hyperparams(spec, known) if len(known) < len(points) else []
    return [largest if values is None else [values] for _, values in points]


def _total(trials: Sequence[TrialPlan], of_points: Sequence[int]) -> int:
    """Return the sum over trials of a number that is known for each point."""
    return sum(of_points[trial.point_index] for trial in trials)


def _largest(
    sizes: list[list[Hyperparams]], of_points: Sequence[_Own], measure: Callable[[_Own, Hyperparams], int]
) -> list[int]:
    """Return the largest measure for each point; a list that is shared by many points is measured once."""
    known: dict[int, int] = {}
    for values, own in zip(sizes, of_points, strict=True):
        if id(values) not in known:
            known[id(values)] = max(measure(own, each) for each in values)
    return [known[id(values)] for values in sizes]


def _notes(spec: SweepSpec, env: EnvInfo, packs: PackPlan | None, concurrent: int) -> list[str]:
    """Return notes on the sweep; `concurrent` is how many trials run at once."""
    notes = [*repeated_points_notes(spec), *env_notes(spec, env, packs)]
    wanted = spec.resources.max_concurrent
    if wanted is not None and packs is None and concurrent < min(wanted, num_points_of(spec) * spec.seeds_per_point):
        notes.append(f"resources.max_concurrent is {wanted}, but only {counted(concurrent, 'trial')} can run at once.")
    return notes

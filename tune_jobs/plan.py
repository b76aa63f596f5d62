"""What a sweep will do, before anything starts: trials, seeds, resources, upper bounds of env steps and disk.

A plan is a function of the sweep and the machine alone, and its trials of the sweep alone: planning the same
sweep with more samples gives the same trials first. What can't run is refused here, with the numbers.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from policies.convolution import output_shape
from policies.envs import EnvInfo, check_env
from policies.errors import CannotRunError, SpecError
from policies.hyperparams import (
    DQNHyperparams,
    Hyperparams,
    PPOHyperparams,
    RandomHyperparams,
    make_hyperparams,
)
from tune_jobs.env_rules import check_env_args, check_env_rules
from tune_jobs.own_code import check_rl_module
from tune_jobs.points import largest_hyperparams, planned_points
from tune_jobs.search_space import num_points
from tune_jobs.seeds import SEEDS_PER_TRIAL, confirmation_seeds, evaluation_seeds, trial_seeds
from tune_jobs.spec import SweepSpec, describe, dotted
from tune_jobs.tpe import check_installed

NUM_CONFIRMATION_EPISODES = 100
MAX_TRIALS = 100_000

# Measured with Ray 2.60 and rounded up: an RLlib checkpoint without its weights, a line of results with its
# TensorBoard scalars, and what is made once (videos, report, Ray Tune's own state).
_CHECKPOINT_BASE_BYTES = 250_000
_ITERATION_BYTES = 10_000
_SWEEP_BYTES = 20_000_000
_BYTES_PER_WEIGHT = 4
_FOR_EVER = "It would wait for ever."
# The network, its copy for sampling, DQN's target network, and Adam's two moments.
_COPIES_OF_WEIGHTS = 6


@dataclass(frozen=True)
class Machine:
    """What there is to run on."""

    num_cpus: float
    num_gpus: float = 0.0
    source: str = "this machine"
    nodes: tuple[tuple[float, float], ...] = ()
    """(CPUs, GPUs) of each node of a cluster; empty: one node that has everything."""


@dataclass(frozen=True)
class TrialPlan:
    """One trial to be run."""

    trial_id: str
    index: int
    point_index: int
    seed_index: int
    seed: int
    point: dict[str, Any]
    """The sampled values alone."""
    hyperparams: dict[str, Any]
    """All values, validated, as JSON."""
    has_point: bool = True
    """False: the search method chooses the point when the trial starts; point and hyperparams are empty until then."""


@dataclass(frozen=True)
class SweepPlan:
    """Everything a sweep will do."""

    trials: tuple[TrialPlan, ...]
    num_points: int
    cpus_per_trial: int
    gpus_per_trial: float
    max_concurrent: int
    evaluation_seeds: tuple[int, ...]
    confirmation_seeds: tuple[int, ...]
    max_env_steps: int
    """Upper bound over all trials, if none is retried; evaluation episodes don't count."""
    max_disk_bytes: int
    """Estimate of the most the sweep folder will hold."""
    env: EnvInfo
    machine: Machine
    notes: tuple[str, ...] = ()
    """What the sweep's author may not have meant."""

    def to_json(self) -> dict[str, Any]:
        """The plan as JSON-like data, without the environment's spaces."""
        data = {name: value for name, value in vars(self).items() if name not in ("trials", "env", "machine")}
        env = {"id": self.env.env_id, "args": self.env.env_args, "threshold": self.env.threshold}
        return data | {
            "num_trials": len(self.trials),
            "trials": [asdict(trial) for trial in self.trials],
            "env": env,
            "machine": asdict(self.machine),
        }


def trial_id(index: int) -> str:
    """Name of a trial, such as t0007; sorts by index up to 10,000 trials."""
    return f"t{index:04d}"


def local_machine() -> Machine:
    """The CPUs this process may use (affinity and cgroup quota count) and the GPUs it sees."""
    return Machine(num_cpus=_usable_cpus(), num_gpus=_visible_gpus())


def make_plan(spec: SweepSpec, machine: Machine) -> SweepPlan:
    """Plan a sweep for a machine.

    Raises:
        EnvError: The environment isn't registered, can't be made, or doesn't go with the algorithm.
        SpecError: A point's values contradict each other or the environment, there are too many trials, or something is
            in a module that is not allowed.
        CannotRunError: One trial needs more than the machine has, or the search method is not installed.
    """
    if spec.search.type == "tpe":
        check_installed()
    check_env_args(spec)
    env = check_env(spec.env.id, spec.env.wrapped_args, spec.algorithm)
    check_rl_module(spec)
    num_trials = _num_trials(spec)
    if num_trials > MAX_TRIALS:
        raise SpecError(
            f"The sweep has {num_trials:,} trials; at most {MAX_TRIALS:,} can be planned.",
            "Lower num_samples or seeds_per_point, or make the grids smaller.",
        )
    concurrent = _max_concurrent(spec, machine, num_trials)
    trials, known = _trials(spec)
    check_env_rules(spec, env, known)
    sizes = _sizes(spec, known)
    return SweepPlan(
        trials=trials,
        num_points=num_trials // spec.seeds_per_point,
        cpus_per_trial=spec.cpus_per_trial,
        gpus_per_trial=spec.resources.num_gpus,
        max_concurrent=concurrent,
        evaluation_seeds=evaluation_seeds(spec.seed, spec.evaluation.num_episodes),
        confirmation_seeds=confirmation_seeds(spec.seed, NUM_CONFIRMATION_EPISODES),
        max_env_steps=spec.seeds_per_point * sum(max(_max_env_steps(spec, each) for each in sets) for sets in sizes),
        max_disk_bytes=_SWEEP_BYTES
        + spec.seeds_per_point * sum(max(_max_trial_bytes(spec, env, each) for each in sets) for sets in sizes),
        env=env,
        machine=machine,
        notes=tuple(_notes(spec, env, concurrent)),
    )


def _num_trials(spec: SweepSpec) -> int:
    points = spec.num_samples if spec.search.type == "tpe" else num_points(spec.space, spec.num_samples)
    return points * spec.seeds_per_point


def _trials(spec: SweepSpec) -> tuple[tuple[TrialPlan, ...], list[Hyperparams]]:
    """The trials, and the hyperparameters of each point that is known."""
    points = planned_points(spec)
    seeds = trial_seeds(spec.seed, len(points) * spec.seeds_per_point)
    trials: list[TrialPlan] = []
    known = []
    for point_index, point in enumerate(points):
        dumped: dict[str, Any] = {}
        if point is not None:
            known.append(point_hyperparams(spec, point, point_index))
            dumped = known[-1].model_dump(mode="json")
        for seed_index in range(spec.seeds_per_point):
            index = len(trials)
            trials.append(
                TrialPlan(
                    trial_id(index),
                    index,
                    point_index,
                    seed_index,
                    seeds[index],
                    point or {},
                    dumped,
                    point is not None,
                )
            )
    return tuple(trials), known


def _sizes(spec: SweepSpec, known: list[Hyperparams]) -> list[list[Hyperparams]]:
    """For each point the hyperparameters whose trials are the largest it may have."""
    if spec.scheduler.type == "pbt":
        return [[values, *largest_hyperparams(spec, known)] for values in known]
    unknown = spec.num_samples - len(known) if spec.search.type == "tpe" else 0
    return [[values] for values in known] + ([largest_hyperparams(spec, known)] * unknown if unknown else [])


def point_hyperparams(spec: SweepSpec, point: Mapping[str, Any], point_index: int) -> Hyperparams:
    """All values of a point's trials, validated.

    Raises:
        SpecError: They don't go together.
    """
    shown = ", ".join(f"{name} {value}" for name, value in point.items()) or "no searched values"
    place = f"point {point_index} ({shown}; first trial {trial_id(point_index * spec.seeds_per_point)})"
    try:
        values = make_hyperparams(spec.algorithm, {**spec.hyperparams, **point})
    except ValidationError as error:
        problems = "; ".join(
            f"{dotted(detail['loc'])} {describe(detail['msg'], detail['input'])}".strip()
            for detail in error.errors(include_url=False)
        )
        raise SpecError(
            f"The values of {place} don't go together: {problems}",
            "Correct hyperparams or space so that every combination is valid; --dry-run lists the points.",
        ) from error
    if isinstance(values, RandomHyperparams) and spec.resources.num_env_runners:
        raise SpecError(
            f"resources.num_env_runners is {spec.resources.num_env_runners}, but the baseline {spec.algorithm} plays "
            "in one process.",
            "Leave resources.num_env_runners out, or set num_envs to play in several sub-environments.",
        )
    num_streams = values.num_envs * max(1, spec.resources.num_env_runners)
    if num_streams > SEEDS_PER_TRIAL:
        raise SpecError(
            f"The values of {place} make {num_streams} sub-environments (num_envs {values.num_envs}, "
            f"resources.num_env_runners {spec.resources.num_env_runners}), more than the {SEEDS_PER_TRIAL} "
            "that a trial has seeds for.",
            "Lower num_envs or resources.num_env_runners.",
        )
    return values


def _max_concurrent(spec: SweepSpec, machine: Machine, num_trials: int) -> int:
    """How many trials run at once; refuses a trial that would wait for ever."""
    cpus, gpus = spec.cpus_per_trial, spec.resources.num_gpus
    _refuse_too_large(spec, machine)
    # Env runners are placed one by one and may lie on other nodes; the rest of a trial is one process on one
    # node.
    whole = cpus if spec.resources.num_env_runners == 0 else 0
    nodes = machine.nodes or ((machine.num_cpus, machine.num_gpus),)
    fitting = sum(
        min(int(node_cpus // whole) if whole else num_trials, _times(node_gpus, gpus) if gpus else num_trials)
        for node_cpus, node_gpus in nodes
    )
    limits = [fitting, int(machine.num_cpus // cpus), num_trials]
    if spec.resources.max_concurrent is not None:
        limits.append(spec.resources.max_concurrent)
    return max(1, min(limits))


def _times(available: float, wanted: float) -> int:
    """How often `wanted` GPUs fit; a share of a GPU never spreads over two, 3 x 1/3 fit despite rounding."""
    if wanted > 1:
        return int(available // wanted)
    return int(available) * math.floor(1 / wanted + 1e-9)


def _refuse_too_large(spec: SweepSpec, machine: Machine) -> None:
    cpus, gpus, runners = spec.cpus_per_trial, spec.resources.num_gpus, spec.resources.num_env_runners
    made_of = f" (1 process and {runners} env runners)" if runners and spec.resources.num_cpus is None else ""
    if cpus > machine.num_cpus:
        if runners:
            hint = f"Set resources.num_env_runners to at most {max(0, int(machine.num_cpus) - 1)}"
        else:
            hint = f"Set resources.num_cpus to at most {int(machine.num_cpus)}"
        raise CannotRunError(
            f"One trial needs {cpus} CPUs{made_of}; {machine.source} has {machine.num_cpus:g}. {_FOR_EVER}",
            f"{hint}, or launch on a larger cluster with --address.",
        )
    if gpus > machine.num_gpus:
        raise CannotRunError(
            f"One trial needs {gpus:g} GPUs; {machine.source} has {machine.num_gpus:g}. {_FOR_EVER}",
            "Set resources.num_gpus to 0, or launch on a cluster with GPUs with --address.",
        )
    main = cpus - runners
    if machine.nodes and not any(main <= node_cpus and gpus <= node_gpus for node_cpus, node_gpus in machine.nodes):
        nodes = ", ".join(f"{node_cpus:g} and {node_gpus:g}" for node_cpus, node_gpus in machine.nodes)
        raise CannotRunError(
            f"One trial's process needs {main} CPUs and {gpus:g} GPUs on one node; no node of "
            f"{machine.source} has both (CPUs and GPUs of its nodes: {nodes}). {_FOR_EVER}",
            "Lower resources.num_cpus or resources.num_gpus.",
        )


def _iteration_env_steps(spec: SweepSpec, values: Hyperparams) -> int:
    """Most env steps of one iteration: all sub-environments step together, so the last step overshoots."""
    wanted, num_runners = _wanted_env_steps(values), max(1, spec.resources.num_env_runners)
    if isinstance(values, DQNHyperparams):
        # It ends with a sampling phase, in which each runner makes its share of train_freq.
        return wanted - 1 + num_runners * (math.ceil(values.train_freq / num_runners) - 1 + values.num_envs)
    together = values.num_envs * num_runners
    return (math.ceil(wanted / together) + 1) * together


def _wanted_env_steps(values: Hyperparams) -> int:
    """Env steps an iteration has at least."""
    return values.train_batch_size if isinstance(values, PPOHyperparams) else values.env_steps_per_iteration


def _max_env_steps(spec: SweepSpec, values: Hyperparams) -> int:
    """Most env steps of one trial: it ends with the iteration in which it reaches its cap."""
    iteration = _iteration_env_steps(spec, values)
    return min(spec.stop.num_env_steps - 1 + iteration, spec.stop.num_iterations * iteration)


def _max_trial_bytes(spec: SweepSpec, env: EnvInfo, values: Hyperparams) -> int:
    iterations = min(spec.stop.num_iterations, math.ceil(spec.stop.num_env_steps / _wanted_env_steps(values)))
    checkpoint = _CHECKPOINT_BASE_BYTES + _num_weights(env, values) * _BYTES_PER_WEIGHT * _COPIES_OF_WEIGHTS
    kept = min(spec.checkpoints.keep + 2, math.ceil(iterations / spec.checkpoints.every_iterations) + 2)
    # One more while a new one is being written and the old one not yet deleted.
    return (kept + 1) * checkpoint + iterations * _ITERATION_BYTES


def _num_weights(env: EnvInfo, values: Hyperparams) -> int:
    if isinstance(values, RandomHyperparams):
        return 0
    space: Any = env.action_space
    num_outputs = 2 * int(space.n) if hasattr(space, "n") else 2 * math.prod(space.shape or ())
    shape = tuple(env.observation_space.shape or ())
    weights = 0
    if values.conv_filters is not None:
        channels = [shape[-1], *(item[0] for item in values.conv_filters)]
        for (inputs, outputs), (_, kernel, _) in zip(itertools.pairwise(channels), values.conv_filters, strict=True):
            weights += (inputs * kernel**2 + 1) * outputs
        shape = output_shape(shape, values.conv_filters)
    sizes = [math.prod(shape), *values.hidden_sizes, num_outputs + 1]
    weights += sum((inputs + 1) * outputs for inputs, outputs in itertools.pairwise(sizes))
    networks = 1 if isinstance(values, DQNHyperparams) else 2  # PPO: policy and value function
    return networks * weights


def _notes(spec: SweepSpec, env: EnvInfo, concurrent: int) -> list[str]:
    notes = []
    if (
        spec.search.type == "random"
        and spec.num_samples > 1
        and not any(domain.is_random for domain in spec.space.values())
    ):
        notes.append(
            f"The space has no random domain, so num_samples {spec.num_samples} repeats every point; "
            "seeds_per_point does that and averages over the seeds."
        )
    target = spec.stop.training_return
    if env.threshold is not None and target is not None and target < env.threshold:
        notes.append(
            f"stop.training_return {target:g} is below {env.env_id}'s threshold {env.threshold:g}: "
            "trials may end before they solve it."
        )
    wanted = spec.resources.max_concurrent
    if wanted is not None and concurrent < min(wanted, _num_trials(spec)):
        notes.append(f"resources.max_concurrent is {wanted}, but only {concurrent} trials fit at once.")
    return notes


def _usable_cpus() -> float:
    affinity = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    quota = _cgroup_quota(Path("/sys/fs/cgroup"))
    # Ray counts whole CPUs; half a CPU still is one process.
    return float(affinity if quota is None else max(1, min(affinity, math.ceil(quota))))


def _cgroup_quota(root: Path) -> float | None:
    """CPUs a container may use by its cgroup (v2, then v1), None if it isn't limited."""
    try:
        quota, period = (root / "cpu.max").read_text(encoding="ascii").split()
        return None if quota == "max" else int(quota) / int(period)
    except (OSError, ValueError):
        pass
    try:
        micros = int((root / "cpu/cpu.cfs_quota_us").read_text(encoding="ascii"))
        return None if micros < 0 else micros / int((root / "cpu/cpu.cfs_period_us").read_text(encoding="ascii"))
    except (OSError, ValueError, ZeroDivisionError):
        return None


def _visible_gpus() -> float:
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return float(len([name for name in visible.split(",") if name.strip() not in ("", "-1")]))
    return float(len(list(Path("/proc/driver/nvidia/gpus").glob("*"))))

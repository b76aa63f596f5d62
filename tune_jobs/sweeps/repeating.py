"""A sweep that repeats one trial of another: its plan, and what it refuses."""

from __future__ import annotations

from analysis.records import SweepRecord, TrialRecord
from analysis.wording import counted
from policies.errors import CannotRunError, SpecError
from policies.guard.guarded import check_env, measure_step
from tune_jobs.plan.engine_choice import PackPlan
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import SweepPlan
from tune_jobs.spec.engines import engine_named
from tune_jobs.spec.sweep_spec import SweepSpec, check_trainable


def check_takes_more(record: SweepRecord) -> None:
    """Check that more trials, or more tries of one, may come to a sweep.

    Raises:
        SpecError: It repeats a trial of another sweep, and is that trial alone.
    """
    if record.repeats is not None:
        sweep = record.repeats.rpartition("/")[0]
        raise SpecError(
            f"{record.name} repeats trial {record.repeats}, as `tune-jobs reproduce` made it, and has no other trials.",
            f"Add them to sweep {sweep}; or repeat the trial once more, into another folder.",
        )


def plan_of_repetition(spec: SweepSpec, trial: TrialRecord, record: SweepRecord, machine: Machine) -> SweepPlan:
    """Return the plan of a sweep that repeats one trial.

    Args:
        spec: The sweep.
        trial: Its trial.
        record: Its record.
        machine: What it runs on.

    Raises:
        SpecError: An older version launched the sweep with a setting that is refused now.
        CannotRunError: The trial needs more than the machine has.
        EnvError: The environment can't be made.
    """
    check_trainable(spec)
    cpus, gpus = spec.cpus_per_trial, spec.resources.num_gpus
    if machine.fitting(cpus, gpus) < 1:
        raise CannotRunError(
            f"{trial.trial_id} needs {counted(cpus, 'CPU')} and {gpus:g} GPUs; {machine.source} has "
            f"{machine.num_cpus:g} and {machine.num_gpus:g}.",
            "Run it on a machine like the one it ran on.",
        )
    env_id, env_args, timeout_s = spec.env.id, spec.env.wrapped_args, spec.iteration_timeout_s
    env = check_env(env_id, env_args, spec.algorithm, timeout_s=timeout_s)
    packs = None
    if engine_named(trial.engine).trains_many:
        from policies.packed.envs.make import choose_kind

        choice = choose_kind(measure_step(env_id, env_args, timeout_s=timeout_s), spare_cpus=0)
        packs = PackPlan(
            num_packs=1, slots=1, cpus_per_pack=cpus, gpus_per_pack=gpus, trial_ids=(trial.trial_id,),
            env_kind=choice.kind, env_step_us=choice.step_us, num_env_processes=0,
        )  # fmt: skip
    return SweepPlan(
        trials=(trial,), num_points=1, cpus_per_trial=cpus, gpus_per_trial=gpus, max_concurrent=1,
        max_concurrent_alone=1, evaluation_seeds=record.evaluation_seeds, confirmation_seeds=record.confirmation_seeds,
        max_env_steps=0, max_disk_bytes=0, env=env, machine=machine, packs=packs,
    )  # fmt: skip

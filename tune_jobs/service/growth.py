"""What may be added to a sweep: its limits hold for what it will have, once all that waits is done, too."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from analysis.records import FINISHED, SweepRecord, TrialRecord
from policies.errors import SpecError
from policies.hyperparams import Hyperparams, make_hyperparams
from tune_jobs.plan.estimates import max_env_steps
from tune_jobs.plan.points import num_points_of, num_trials_of
from tune_jobs.service.config import Limits
from tune_jobs.service.jobs import Job
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.spec.training_length import hyperparams_in


@dataclass(frozen=True)
class Addition:
    """What somebody asks for."""

    num_samples: int = 0
    """More random draws for each combination of the grids."""
    points: Sequence[dict[str, Any]] = ()
    top: int = 0
    """How many settings race."""
    seeds: int = 0
    """How many more seeds one of them gets at most."""


def num_samples_after(spec: SweepSpec, jobs: Iterable[Job]) -> int:
    """Return how many samples a sweep will have, once its jobs that wait or run are done."""
    asked = [int(job.arguments["to_num_samples"]) for job in jobs if job.verb == "extend"]
    return max([spec.num_samples, *asked])


def num_trials_after(record: SweepRecord, spec: SweepSpec, *, jobs: Sequence[Job], more: Addition) -> int:
    """Return the most trials that a sweep will have, once its jobs that wait or run are done, and an addition is.

    They are counted as they will be planned: those that there are now may be fewer than the sweep's spec says.

    Args:
        record: The sweep.
        spec: Its spec.
        jobs: Its jobs that wait or run.
        more: What is to be added.
    """
    wanted = spec.model_copy(update={"num_samples": num_samples_after(spec, jobs) + more.num_samples})
    num_new = len(_new_points(record, jobs, more))
    total = num_trials_of(wanted, record.replications, record.chosen_points) + num_new * spec.seeds_per_point
    races = [(int(job.arguments["top"]), int(job.arguments["seeds"])) for job in jobs if job.verb == "replicate"]
    num_points = num_points_of(wanted, record.chosen_points) + num_new
    return total + sum(min(top, num_points) * seeds for top, seeds in [*races, (more.top, more.seeds)])


def check_growth(
    limits: Limits,
    record: SweepRecord,
    spec: SweepSpec,
    trials: Sequence[TrialRecord],
    *,
    jobs: Sequence[Job],
    more: Addition,
) -> None:
    """Check that a sweep stays within the limits.

    Args:
        limits: The service's.
        record: The sweep.
        spec: Its spec.
        trials: Its trials so far.
        jobs: Its jobs that wait or run.
        more: What is to be added.

    Raises:
        SpecError: It would have too many trials, or might train too many env steps.
    """
    total = num_trials_after(record, spec, jobs=jobs, more=more)
    if total > limits.trials:
        raise SpecError(
            f"The sweep would have {total:,} trials; here a sweep may have at most {limits.trials:,}.", "Add fewer."
        )
    if limits.env_steps is None:
        return
    steps = [max_env_steps(spec, values) for values in _hyperparams(spec, trials, _new_points(record, jobs, more))]
    # Of points that are not drawn yet, the largest known stands for all.
    most = sum(steps[: len(trials)]) + max(0, total - len(trials)) * max(steps)
    if most > limits.env_steps:
        raise SpecError(
            f"The sweep might train {most:,} env steps; here it may train at most {limits.env_steps:,}.", "Add fewer."
        )


def num_cpus_after(
    record: SweepRecord,
    spec: SweepSpec,
    trials: Sequence[TrialRecord],
    *,
    jobs: Sequence[Job],
    more: Addition,
    retry_failed: bool = False,
) -> int:
    """Return how many CPUs a sweep can use at most once something is added: as if all that is left ran at once.

    Args:
        record: The sweep.
        spec: Its spec.
        trials: Its trials so far.
        jobs: Its jobs that wait or run.
        more: What is to be added.
        retry_failed: Whether its failed trials run again.
    """
    # A race trains each of its settings once, then again those that are still in it.
    at_once = replace(more, seeds=min(1, more.seeds))
    ended = sum(trial.status in FINISHED and not (retry_failed and trial.status == "failed") for trial in trials)
    return max(1, num_trials_after(record, spec, jobs=jobs, more=at_once) - ended) * spec.cpus_per_trial


def _new_points(record: SweepRecord, jobs: Sequence[Job], more: Addition) -> list[dict[str, Any]]:
    """Return the points of somebody's choice that the sweep does not have yet."""
    known = [item.point for item in record.chosen_points]
    asked = [job.arguments["point"] for job in jobs if job.verb == "inject"]
    return [*(point for point in asked if point not in known), *more.points]


def _hyperparams(spec: SweepSpec, trials: Sequence[TrialRecord], points: Sequence[dict[str, Any]]) -> list[Hyperparams]:
    """Return those of trials and points; without any, the fixed values."""
    own = [trial.hyperparams if trial.has_point else spec.hyperparams for trial in trials]
    given = [*own, *({**spec.hyperparams, **hyperparams_in(point)} for point in points)]
    return [make_hyperparams(spec.algorithm, dict(values)) for values in given or [spec.hyperparams]]

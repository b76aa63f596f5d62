"""Judge the settings of a sweep by its objective."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from analysis.best_records import BestRecord, SettingsRecord
from analysis.objectives import SettingScores, rank_settings
from analysis.records import IterationRecord, TrialRecord
from analysis.settings import judge_settings
from policies.guard.guarded import check_env
from policies.portable.file import read_policy
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.candidates import read_results, read_trials
from tune_jobs.store.contract import Sweep


def judged(
    spec: SweepSpec,
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    threshold: float | None,
) -> SettingsRecord | None:
    """Rank the settings of a sweep; None in a population, whose trials change theirs while they train.

    None, too, where they are judged by the env steps to a threshold and nobody knows it any more.

    Args:
        spec: The sweep.
        trials: Its trials.
        results: Iterations by trial id, oldest first.
        threshold: The env's own threshold; None: it has none.
    """
    if spec.scheduler.is_population:
        return None
    goal = goal_of(spec, threshold)
    if spec.objective.type == "steps_to_threshold" and goal is None:
        return None
    return judge_settings(
        trials, results, spec.objective.type, num_env_steps=spec.stop.num_env_steps,
        num_iterations=spec.stop.num_iterations, threshold=goal, cost=spec.objective.cost,
    )  # fmt: skip


def ranked(
    spec: SweepSpec,
    trials: Sequence[TrialRecord],
    results: Mapping[str, Sequence[IterationRecord]],
    threshold: float | None,
) -> list[SettingScores]:
    """Return all settings of a sweep with their scores, best first; the arguments are those of `judged`."""
    goal = goal_of(spec, threshold)
    return rank_settings(
        trials, results, spec.objective.type, num_env_steps=spec.stop.num_env_steps,
        num_iterations=spec.stop.num_iterations, threshold=goal,
    )  # fmt: skip


def threshold_for(spec: SweepSpec) -> float | None:
    """Return the env's own threshold where the objective is about it; None: it is not, or the env has none.

    Raises:
        EnvError: The env cannot be made.
        EnvFailedError: As for EnvError, and it failed.
    """
    if spec.objective.type != "steps_to_threshold":
        return None
    return check_env(spec.env.id, spec.env.wrapped_args, timeout_s=spec.iteration_timeout_s).threshold


def goal_of(spec: SweepSpec, threshold: float | None) -> float | None:
    """Return the return to reach: the objective's, else the env's own."""
    return threshold if spec.objective.threshold is None else spec.objective.threshold


def with_present_settings(store: Sweep, best: BestRecord) -> BestRecord:
    """Return the confirmed winner with the settings as they are judged now; it is written if they are others by now.

    They are after a replication, which may leave the winner as it is.

    Raises:
        CheckpointError: The record of the sweep or of a trial, or the winner's policy, is damaged.
        CannotRunError: The record cannot be written.
    """
    spec = stored_spec(store.read_record())
    settings = judged(spec, read_trials(store), read_results(store), best.confirmation.threshold)
    if settings == best.settings:
        return best
    record = best.model_copy(update={"settings": settings})
    store.write_best(record, read_policy(store.best_folder))
    return record

"""Replicate a sweep: train its leading settings again with fresh seeds, until it is clear which is the best."""

from __future__ import annotations

from analysis.racing import Race
from policies.errors import NotFoundError, SpecError
from policies.guard.guarded import check_env
from tune_jobs.plan.sweep_plan import MAX_TRIALS
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.candidates import read_results, read_trials
from tune_jobs.store.contract import Sweep
from tune_jobs.sweeps.outcome import SweepResult
from tune_jobs.sweeps.resume import replicate
from tune_jobs.sweeps.settings import ranked


def run_race(store: Sweep, address: str | None, *, top: int, seeds: int, finish: bool, progress: str) -> SweepResult:
    """Run what is missing of a sweep, then a race of its leading settings.

    Raises:
        SpecError: The sweep cannot be replicated, or has one setting only.
        NotFoundError: It has no setting that was trained and evaluated.
        CannotRunError: Another process runs the sweep, or it cannot run here.
    """
    spec = stored_spec(store.read_record())
    race: Race | None = None
    num_done = 0

    def next_points() -> tuple[int, ...]:
        nonlocal race, num_done
        # Only now, as the modules that the sweep's environment may need are allowed by the run.
        threshold = check_env(spec.env.id, spec.env.wrapped_args, timeout_s=spec.iteration_timeout_s).threshold
        ranking = ranked(spec, read_trials(store), read_results(store), threshold)
        if not ranking:
            raise NotFoundError(
                f"No setting of sweep {store.name} can be replicated: none of its trials was evaluated.",
                f"See why with `tune-jobs trials {store.name}`.",
            )
        if len(ranking) == 1:
            raise SpecError(
                f"Sweep {store.name} has one setting that was trained: there is no other to race it with.",
                "Extend the sweep by more samples, or launch it anew with seeds_per_point for more seeds of the one.",
            )
        if race is None:
            race = Race(tuple(item.point_index for item in ranking[:top]), seeds)
            if race.max_trainings > MAX_TRIALS:
                raise SpecError(
                    f"The race has up to {race.max_trainings:,} trainings (top {top:,}, seeds {seeds:,}); at most "
                    f"{MAX_TRIALS:,} can be planned.",
                    "Lower seeds or top.",
                )
        scores = {item.point_index: item.scores for item in ranking}
        points = race.next_points(scores, num_done)
        num_done += 1
        return points

    return replicate(store, address, next_points, finish=finish, progress=progress)

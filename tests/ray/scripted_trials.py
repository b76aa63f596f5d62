"""Trials whose scores are known beforehand, run by Ray Tune under a sweep's scheduler: no training, a second or two."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ray import tune

from tune_jobs.ray_tune.early_stopping import build_tune_scheduler
from tune_jobs.spec.scheduler import SchedulerSpec

STEPS = 100


def run_scripted(
    folder: Path,
    scheduler: SchedulerSpec,
    scores: Sequence[float | None],
    *,
    max_env_steps: int,
    evaluate_every: int = 1,
) -> list[int]:
    """Run one trial a score, one after another where the scheduler lets them; returns the env steps each came to.

    Args:
        folder: Where everything is written.
        scheduler: A `SchedulerSpec`.
        scores: Evaluation return of each trial, at each evaluation; None: not a finite number.
        max_env_steps: Of a trial; a report is 100.
        evaluate_every: Reports between two evaluations.
    """
    # Defined in here, or the worker processes would look for a module that only this one has.
    from tune_jobs.ray_tune.trainable import TrialTrainable
    from tune_jobs.store.progress import Progress

    steps = STEPS

    class Scripted(TrialTrainable):
        def step(self) -> dict[str, Any]:
            path = Path(self._trial[0]) / f"{self._trial[1]}.txt"
            count = 1 + (int(path.read_text()) if path.exists() else 0)
            path.write_text(str(count))
            score = scores[int(self._trial[1].removeprefix("t"))]
            evaluated = count % evaluate_every == 0
            progress = Progress(
                num_iterations=count, num_env_steps=count * steps, num_episodes=count, time_s=1.0, training_return=None,
                evaluation_return=score if evaluated else 1e6, best_evaluation_return=score, best_iteration=None,
                evaluated=evaluated, status="completed" if count * steps >= max_env_steps else "running",
            )  # fmt: skip
            return self._report(progress)

    folder.mkdir(parents=True, exist_ok=True)
    tune.Tuner(
        tune.with_resources(Scripted, {"CPU": 1}),
        param_space={
            "sweep_place": str(folder),
            "trial_id": tune.grid_search([f"t{index:04d}" for index in range(len(scores))]),
        },
        tune_config=tune.TuneConfig(
            scheduler=build_tune_scheduler(scheduler, max_env_steps),
            # One at a time, or who is compared with whom would depend on which process starts first.
            max_concurrent_trials=None if scheduler.waits_for_others else 1,
            reuse_actors=True,
            trial_name_creator=lambda trial: trial.config["trial_id"],
            trial_dirname_creator=lambda trial: trial.config["trial_id"],
        ),
        run_config=tune.RunConfig(name="run", storage_path=str(folder / "tune"), verbose=0),
    ).fit()
    return [int((folder / f"t{index:04d}.txt").read_text()) * STEPS for index in range(len(scores))]

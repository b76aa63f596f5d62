"""Runs a preset over training seeds and measures each seed's best checkpoint on seeds nothing was chosen on."""

from __future__ import annotations

import re
import statistics
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from analysis.best_records import EvaluationRecord
from analysis.records import TrialRecord
from analysis.statistics import median_steps
from analysis.tables import env_steps_to
from tests.learning.targets import NUM_EPISODES, Target, Task
from tune_jobs.spec.file import Preset, find_preset
from tune_jobs.spec.seeds import confirmation_seeds
from tune_jobs.store.candidates import read_results
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.sources import find_sweep


@dataclass(frozen=True)
class SeedResult:
    """One training seed."""

    trial_id: str
    score: float
    """Mean return of its best checkpoint over `NUM_EPISODES` greedy episodes."""
    returns: tuple[float, ...]
    random_score: float
    """Random play's, on the same episode seeds."""
    num_env_steps: int
    """Of its trial, in all."""
    best_num_env_steps: int | None
    """After which its best checkpoint was saved."""
    num_env_steps_to_solve: int | None
    time_s: float


@dataclass(frozen=True)
class Measurement:
    """A preset over its training seeds."""

    preset: str
    seeds: tuple[SeedResult, ...]
    num_failed: int
    time_s: float
    """Wall time, Ray's start and the evaluation after it included."""

    @property
    def score(self) -> float | None:
        """Median over the training seeds; None if none is left."""
        return statistics.median([seed.score for seed in self.seeds]) if self.seeds else None

    @property
    def solve_median(self) -> float | None:
        """Median env steps to solve; None: never."""
        return median_steps([seed.num_env_steps_to_solve for seed in self.seeds]) if self.seeds else None

    @property
    def times_random(self) -> float | None:
        """The median score in units of random play's."""
        return None if self.score is None else self.score / self.seeds[0].random_score

    def full_episodes(self, num_episodes: int, full: float) -> float | None:
        """How many of the first episodes have the full return: the median over the seeds."""
        counts = [sum(value >= full for value in seed.returns[:num_episodes]) for seed in self.seeds]
        return statistics.median(counts) if counts else None


def measure(task: Task, num_seeds: int, storage: Path) -> Measurement:
    """Train a preset with so many training seeds and evaluate each seed's best checkpoint.

    Raises:
        TuneJobsError: It cannot run.
    """
    started = time.perf_counter()
    result = sweeps.launch(
        task.preset, overrides=[f"seeds_per_point={num_seeds}"], name=task.preset, storage=storage, finish=False,
        progress="none",
    )  # fmt: skip
    if result.interrupted:
        raise KeyboardInterrupt
    store = find_sweep(result.folder)
    results = read_results(store)
    spec = result.sweep.spec
    first_seed = confirmation_seeds(spec["seed"], NUM_EPISODES)[0]
    seeds = []
    for trial in result.trials:
        if trial.status != "completed" or trial.best_iteration is None:
            continue
        policy, random = sweeps.evaluate(
            f"{task.preset}/{trial.trial_id}", storage=storage, num_episodes=NUM_EPISODES, first_seed=first_seed
        )
        goal = task.shown_target.solve_return
        steps = env_steps_to(policy.threshold if goal is None else goal, results[trial.trial_id])
        seeds.append(_seed_result(trial, policy, random, steps))
    num_failed = len(result.trials) - len(seeds)
    return Measurement(task.preset, tuple(seeds), num_failed, time.perf_counter() - started)


def _seed_result(
    trial: TrialRecord, policy: EvaluationRecord, random: EvaluationRecord, steps_to_solve: int | None
) -> SeedResult:
    best = next((item for item in trial.checkpoints if item.iteration == trial.best_iteration), None)
    return SeedResult(
        trial_id=trial.trial_id,
        score=policy.mean_return,
        returns=policy.returns,
        random_score=random.mean_return,
        num_env_steps=trial.num_env_steps,
        best_num_env_steps=None if best is None else best.num_env_steps,
        num_env_steps_to_solve=steps_to_solve,
        time_s=trial.time_s,
    )


def misses(target: Target, found: Measurement) -> list[str]:
    """What of a target a measurement does not reach, each as a short text; none: it is reached."""
    if found.score is None:
        return ["every trial failed"]
    missed = [f"{found.num_failed} trials failed"] if found.num_failed else []
    if target.score is not None and found.score < target.score:
        missed.append(f"score {found.score:.1f} < {target.score:g}")
    if target.max_env_steps is not None:
        most = max(seed.num_env_steps for seed in found.seeds)
        missed += [f"{most:,} env steps > {target.max_env_steps:,}"] if most > target.max_env_steps else []
    if target.solve_within is not None:
        median = found.solve_median
        if median is None or median >= target.solve_within:
            took = "never solved in training" if median is None else f"solved after {median:,.0f}"
            missed.append(f"{took}, not within {target.solve_within:,} env steps")
    if target.full_episodes is not None:
        wanted, of, full = target.full_episodes
        count = found.full_episodes(of, full)
        missed += [f"{count:g} of {of} episodes at {full:g} < {wanted}"] if count is None or count < wanted else []
    if target.times_random is not None:
        times = found.times_random
        if times is None or times < target.times_random:
            missed.append(f"{times:.2f} x random play < {target.times_random:g} x")
    return missed


def verdict(task: Task, found: Measurement) -> tuple[bool, str]:
    """Whether a preset passes, and the word for the table: pass, MISS, or why it is neither."""
    missed = misses(task.shown_target, found)
    if task.target is None:
        return True, f"measured; the target is {task.preset}-fixed's"
    if not missed:
        return True, "pass"
    if task.target.times_random is not None and not found.num_failed and owns_up(find_preset(task.preset)):
        return True, f"honest: the preset says so ({'; '.join(missed)})"
    return False, f"MISS: {'; '.join(missed)}"


def owns_up(preset: Preset) -> bool:
    """Whether a preset says of itself that it is not better than random play."""
    words = f"{preset.shows} {preset.expected} {preset.description}".lower()
    return re.search(r"\b(not|no|never|hardly)\b[^.;]{0,40}\b(beat|better)[^.;]{0,30}\brandom\b", words) is not None


def to_json(task: Task, found: Measurement | None, reason: str = "") -> dict[str, Any]:
    """A result as JSON-like data; of a preset that was skipped, the reason."""
    data: dict[str, Any] = {"preset": task.preset, "target": asdict(task.shown_target)}
    if found is None:
        return data | {"skipped": reason}
    passed, word = verdict(task, found)
    return data | {
        "score": found.score,
        "times_random": found.times_random,
        "num_env_steps_to_solve": found.solve_median,
        "time_s": found.time_s,
        "num_failed": found.num_failed,
        "passed": passed,
        "verdict": word,
        "seeds": [asdict(seed) for seed in found.seeds],
    }

"""Sweeps that look like real ones, without training: for the tests of tables, plots and report."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from analysis.best_records import BestRecord, CandidateRecord, ChoiceRecord, EvaluationRecord
from analysis.records import CheckpointRecord, IterationRecord, SweepRecord, TrialRecord, TrialStatus
from analysis.selection import NoUsableTrialError, policy_candidates, select_best
from analysis.settings import judge_settings
from analysis.successive_rejects import TIED

ERROR = """RuntimeError: env.step raised ZeroDivisionError: the cart left the track
Traceback (most recent call last):
  File "envs/cart.py", line 31, in step
    return self._advance(action / self.gap)
ZeroDivisionError: the cart left the track

Last lines of trials/t0003/log.txt:
  iteration 4: 4096 env steps, training return 23.1
"""


@dataclass
class Synthetic:
    sweep: SweepRecord
    trials: list[TrialRecord]
    results: dict[str, list[IterationRecord]]
    best: BestRecord | None
    videos: dict[str, Path] = field(default_factory=dict)


def make_points(num_samples: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    grid = [([size], activation) for size in (32, 64) for activation in ("linear", "relu")]
    return [
        {"hidden_sizes": list(sizes), "activation": activation, "lr": float(rng.uniform(1e-7, 1e-2))}
        for _ in range(num_samples)
        for sizes, activation in grid
    ]


def make_sweep(
    *,
    points: Sequence[dict[str, Any]] | None = None,
    seeds_per_point: int = 1,
    failed: Collection[int] = (),
    pending: Collection[int] = (),
    algorithm: str = "ppo",
    env_id: str = "CartPole-v0",
    threshold: float | None = 195.0,
    cap: float = 200.0,
    max_steps: int = 50_000,
    steps_per_iteration: int = 1024,
    seed: int = 0,
    name: str = "cartpole-ppo-1",
    error: str = ERROR,
    with_best: bool = True,
) -> Synthetic:
    """A finished sweep; `failed` and `pending` are trial indices."""
    rng = np.random.default_rng(seed)
    points = make_points(5, rng) if points is None else points
    trials: list[TrialRecord] = []
    results: dict[str, list[IterationRecord]] = {}
    for index in range(len(points) * seeds_per_point):
        point = points[index // seeds_per_point]
        status: TrialStatus = "failed" if index in failed else "pending" if index in pending else "completed"
        stop_at = {"failed": 5, "pending": 0}.get(status, math.ceil(max_steps / steps_per_iteration))
        rows = make_iterations(
            point,
            rng,
            num_iterations=stop_at,
            steps_per_iteration=steps_per_iteration,
            cap=cap,
            threshold=threshold,
        )
        trial = make_trial(index, seeds_per_point=seeds_per_point, point=point, status=status, rows=rows)
        if trial.stop_reason is not None and len(rows) < stop_at:
            trial = trial.model_copy(update={"stop_reason": f"training_return {threshold} >= {threshold}"})
        trials.append(trial.model_copy(update={"error": error if status == "failed" else None}))
        results[trial.trial_id] = rows
    sweep = make_sweep_record(name, algorithm, env_id, trials, seeds_per_point)
    best = None
    if with_best:
        try:
            best = make_best(trials, env_id, threshold, cap, rng)
            settings = judge_settings(trials, results, num_env_steps=max_steps, threshold=threshold)
            best = best.model_copy(update={"settings": settings})
        except NoUsableTrialError:
            best = None
    return Synthetic(sweep, trials, results, best)


def make_iterations(
    point: Mapping[str, Any],
    rng: np.random.Generator,
    *,
    num_iterations: int,
    steps_per_iteration: int,
    cap: float,
    threshold: float | None,
) -> list[IterationRecord]:
    log_lr = math.log10(point.get("lr", 3e-3))
    speed = math.exp(-((log_lr + 2.5) ** 2) / 0.5) * (1.6 if sum(point.get("hidden_sizes", [64])) >= 64 else 1.0)
    ceiling = cap * (0.75 if point.get("activation") == "linear" else 1.4)
    rows: list[IterationRecord] = []
    last: list[float] = []
    num_episodes = 0
    for iteration in range(1, num_iterations + 1):
        progress = 1 - math.exp(-speed * iteration / 10)
        mean = min(1.04 * cap, 20 + (ceiling - 20) * progress**1.5)
        returns: list[float] = []
        while sum(returns) < steps_per_iteration:
            returns.append(float(min(cap, max(8, round(rng.normal(mean, 0.2 * mean * (mean < 0.97 * cap)))))))
        num_episodes += len(returns)
        last = (last + returns)[-100:]
        evaluation = float(np.mean(np.clip(rng.normal(1.08 * mean, 8, size=10), 9, cap)))
        rows.append(
            IterationRecord(
                iteration=iteration,
                num_env_steps=iteration * steps_per_iteration,
                num_episodes=num_episodes,
                time_s=iteration * 0.16,
                training_return=float(np.mean(last)),
                evaluation_return=evaluation if iteration % 5 == 0 else None,
                episode_returns=tuple(returns),
                episode_lengths=tuple(int(value) for value in returns),
                learner={"policy_loss": 0.01, "entropy": 0.6},
            )
        )
        if threshold is not None and len(last) == 100 and np.mean(last) >= threshold:
            if rows[-1].evaluation_return is None:
                rows[-1] = rows[-1].model_copy(update={"evaluation_return": evaluation})
            break
    return rows


def make_trial(
    index: int, *, seeds_per_point: int, point: dict[str, Any], status: TrialStatus, rows: Sequence[IterationRecord]
) -> TrialRecord:
    trial_id = f"t{index:04d}"
    evaluated = [row for row in rows if row.evaluation_return is not None]
    top = max(evaluated, key=lambda row: cast("float", row.evaluation_return), default=None)
    kept = sorted({row.iteration: row for row in [top, *rows[-1:]] if row is not None}.items())
    last = rows[-1] if rows else None
    return TrialRecord(
        trial_id=trial_id,
        index=index,
        point_index=index // seeds_per_point,
        seed_index=index % seeds_per_point,
        seed=(7000 + index) * 1024,
        point=point,
        hyperparams=point,
        status=status,
        stop_reason=None if status != "completed" else "stop.num_env_steps",
        num_failures=int(status == "failed"),
        num_iterations=len(rows),
        num_env_steps=last.num_env_steps if last else 0,
        num_episodes=last.num_episodes if last else 0,
        time_s=last.time_s if last else 0.0,
        training_return=last.training_return if last else None,
        evaluation_return=evaluated[-1].evaluation_return if evaluated else None,
        best_evaluation_return=top.evaluation_return if top else None,
        best_iteration=top.iteration if top else None,
        checkpoints=tuple(
            CheckpointRecord(
                trial_id=trial_id,
                iteration=row.iteration,
                num_env_steps=row.num_env_steps,
                training_return=row.training_return,
                evaluation_return=row.evaluation_return,
            )
            for _, row in kept
        ),
    )


def make_sweep_record(
    name: str, algorithm: str, env_id: str, trials: Sequence[TrialRecord], seeds_per_point: int
) -> SweepRecord:
    return SweepRecord(
        name=name,
        state="completed",
        spec={
            "env": {"id": env_id, "args": {}},
            "algorithm": algorithm,
            "hyperparams": {"num_envs": 8, "gamma": 0.98},
            "space": {
                "hidden_sizes": {"grid": [[32], [64]]},
                "activation": {"grid": ["linear", "relu"]},
                "lr": {"uniform": [1e-7, 1e-2]},
            },
            "num_samples": 5,
            "seeds_per_point": seeds_per_point,
            "seed": 0,
            "stop": {"training_return": 195.0, "num_env_steps": 50_000, "time_s": 3600},
        },
        evaluation_seeds=tuple(range(4711, 4721)),
        confirmation_seeds=tuple(range(900_000, 900_100)),
        num_trials=len(trials),
        created_at=1_763_690_000.0,
        started_at=1_763_690_001.0,
        ended_at=1_763_690_071.0,
        run_time_s=70.4,
        versions={"tune-jobs": "0.1.0", "ray": "2.60.0", "torch": "2.13.0", "python": "3.11.7"},
        git_commit="0123456789abcdef0123456789abcdef01234567",
    )


def make_best(
    trials: Sequence[TrialRecord], env_id: str, threshold: float | None, cap: float, rng: np.random.Generator
) -> BestRecord:
    selection = select_best(trials)
    seeds = tuple(range(900_000, 900_100))
    returns = tuple(float(min(cap, round(value))) for value in rng.normal(selection.score - 1, 6, size=100))
    baseline = tuple(float(round(value)) for value in rng.gamma(4, 6, size=100) + 8)

    def record(policy: str, values: tuple[float, ...]) -> EvaluationRecord:
        return EvaluationRecord(
            policy=policy,
            env_id=env_id,
            seeds=seeds,
            returns=values,
            lengths=tuple(max(1, int(abs(value))) for value in values),
            threshold=threshold,
        )

    return BestRecord(
        checkpoint=selection.checkpoint,
        point=selection.trial.point,
        seed=selection.trial.seed,
        selection_score=selection.score,
        confirmation=record("best/policy.json", returns),
        random=record("random", baseline),
    )


def with_choice(best: BestRecord, trials: Sequence[TrialRecord]) -> BestRecord:
    """Let a winner be chosen from the leading checkpoints: one tied, one lost by its score, one could not be read."""
    known = policy_candidates(trials)
    fates: list[dict[str, Any]] = [
        {"score": 200.0, "num_episodes": 120, "lower": 200.0, "upper": 200.0},
        {"score": 200.0, "num_episodes": 120, "lower": 199.5, "upper": 200.5, "rejected_in": 2, "reason": TIED},
        {"score": 180.25, "num_episodes": 50, "rejected_in": 1},
        {"score": 200.0, "num_episodes": 0, "rejected_in": 0, "reason": "its weights are damaged"},
    ]
    candidates = [
        CandidateRecord(checkpoint=item.checkpoint, point=item.trial.point, **fate)
        for item, fate in zip(known, fates, strict=False)
    ]
    candidates[1] = candidates[1].model_copy(update={"confirmation": best.confirmation})
    choice = ChoiceRecord(
        candidates=tuple(candidates), num_known=len(known), num_evaluation_episodes=10, first_seed=4721, num_rounds=2,
        num_episodes=260, num_env_steps=50_000, max_env_steps=250_000,
        note="Round 2 could not be played: the motor broke",
    )  # fmt: skip
    winner = choice.winner
    return best.model_copy(
        update={
            "checkpoint": winner.checkpoint, "point": winner.point, "selection_score": winner.score, "choice": choice,
        }
    )  # fmt: skip

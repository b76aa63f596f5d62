"""Sweeps of known scores, to be compared, and what is said of them."""

from typing import Any

from synthetic_sweep import make_sweep_record

from analysis.comparison.compare import Comparison
from analysis.comparison.entries import Wanted
from analysis.comparison.pairs import Pair
from analysis.comparison.wording import fact_rows, pair_lines
from analysis.exports.frames import SweepData
from analysis.records import IterationRecord, TrialRecord


def wanted(
    name: str,
    *points: list[float],
    point_index: int | None = None,
    values: list[Any] | None = None,
    objective: Any = "best",
    threshold: float | None = None,
    **sweep: Any,
) -> Wanted:
    """A sweep of points with these scores, one a training seed, each of a trial with one evaluation."""
    lrs = values or [0.1 * (index + 1) for index in range(len(points))]
    trials: list[TrialRecord] = []
    results: dict[str, list[IterationRecord]] = {}
    for index, (scores, lr) in enumerate(zip(points, lrs, strict=True)):
        for seed_index, score in enumerate(scores):
            number, point = len(trials), {"lr": lr}
            trials.append(
                TrialRecord(
                    trial_id=f"t{number:04d}", index=number, point_index=index, seed_index=seed_index, point=point,
                    hyperparams=point, seed=1000 * ord(name[0]) + number, status="completed", num_env_steps=1000,
                    time_s=1.0,
                )
            )  # fmt: skip
            results[f"t{number:04d}"] = [
                IterationRecord(
                    iteration=1, num_env_steps=1000, num_episodes=100, time_s=1.0, evaluation_return=score,
                    training_return=score,
                )
            ]  # fmt: skip
    record = make_sweep_record(name, "ppo", "CartPole-v0", trials, 1).model_copy(update=sweep)
    data = SweepData(trials, results, objective, num_env_steps=50_000, threshold=threshold)
    return Wanted(name if point_index is None else f"{name}/p{point_index}", record, data, 1.0, point_index)


LEFT, RIGHT = [10.0, 12.0, 11.0, 17.0, 13.0], [9.0, 7.0, 11.0, 8.0]


def the_pair(comparison: Comparison) -> Pair:
    (pair,) = comparison.pairs
    return pair


def said(comparison: Comparison) -> str:
    lines = [text for verdict, lines in pair_lines(comparison) for text in (verdict, *lines)]
    cells = [cell for _, row in fact_rows(comparison) for cell in row]
    return "\n".join([*lines, *cells, *comparison.notes, *comparison.not_comparable])

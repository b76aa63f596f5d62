"""What mattered where a scheduler ended trials early: all are judged at the env steps of the first that it ended."""

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import pytest
from known_scores import Sweep, draw, sweep_of

from analysis.importance.cut_short import rows_until
from analysis.records import IterationRecord

GRACE, CAP = 10_000, 100_000


def row(steps: int, evaluation: float | None = None, episodes: tuple[float, ...] = ()) -> IterationRecord:
    return IterationRecord(
        iteration=max(1, steps // 100), num_env_steps=steps, num_episodes=1, time_s=1.0, evaluation_return=evaluation,
        episode_returns=episodes, episode_lengths=(1,) * len(episodes),
    )  # fmt: skip


def equal_curves(batches: tuple[int, ...], *, objective: str = "final", seed: int = 0, num_points: int = 40) -> Sweep:
    """A sweep by ASHA with one rung, whose trials all rise in the same way to a level of their own.

    A trial is evaluated in each fifth iteration and at its end. Which batch it has makes no difference to its curve.
    """
    rng = np.random.default_rng(seed)
    points = [{"train_batch_size": batches[index % len(batches)]} | draw(1, index)[0] for index in range(num_points)]
    space = {"train_batch_size": {"choice": list(batches)}, "lr": {"loguniform": [1e-5, 1e-1]}}
    sweep = sweep_of(
        points, lambda _: 0.0, space=space, objective={"type": objective, "threshold": 40.0},
        stop={"num_env_steps": CAP}, scheduler={"type": "asha"},
    )  # fmt: skip
    filed: list[float] = []
    # As good with each batch.
    levels = np.repeat(rng.uniform(60.0, 200.0, size=num_points // len(batches)), len(batches))
    for index, (point, trial) in enumerate(zip(points, sweep.trials, strict=True)):
        batch, decided = point["train_batch_size"], False

        def returns(steps: Any, level: float = levels[index]) -> Any:
            return 20.0 + (level - 20.0) * (1.0 - np.exp(-3.0 * steps / CAP))

        rows: list[IterationRecord] = []
        status = "completed"
        for iteration in itertools.count(1):
            steps = min(CAP, iteration * batch)
            means = returns(np.arange((iteration - 1) * batch, steps, 100))
            is_evaluated = iteration % 5 == 0 or steps == CAP
            evaluation = float(returns(steps) + rng.normal(0.0, 2.0)) if is_evaluated else None
            rows.append(row(steps, evaluation, tuple(map(float, rng.normal(means, 0.1 * means)))))
            if is_evaluated and steps >= GRACE and not decided:
                decided = True
                filed.append(rows[-1].evaluation_return or 0.0)
                if filed[-1] < float(np.median(filed)):
                    status = "stopped"
                    break
            if steps == CAP:
                break
        sweep.results[trial.trial_id] = rows
        sweep.trials[index] = trial.model_copy(
            update={"status": status, "num_env_steps": rows[-1].num_env_steps, "stop_reason": status}
        )
    return sweep


def with_trial(sweep: Sweep, index: int, rows: list[IterationRecord], **fields: Any) -> Sweep:
    trial = sweep.trials[index]
    trials = list(sweep.trials)
    steps = rows[-1].num_env_steps if rows else 0
    trials[index] = trial.model_copy(update={"num_env_steps": steps} | fields)
    return dataclasses.replace(sweep, trials=trials, results=sweep.results | {trial.trial_id: rows})


@pytest.mark.parametrize(
    ("objective", "large"),
    [("final", 4096), ("area", 4096), ("best", 4096), ("steps_to_threshold", 4096), ("final", 16384)],
)
def test_a_batch_by_which_trials_are_evaluated_later_does_not_matter(objective: str, large: int) -> None:
    # The large ones are first evaluated at 20,480 env steps or later, and the first trial is ended at 10,240.
    clear, means = 0, []
    for seed in range(4):
        mattered = equal_curves((1024, large), objective=objective, seed=seed).mattered
        assert mattered.num_env_steps == 10_240
        assert (mattered.num_points, mattered.num_trials, mattered.objective) == (40, 40, "final")
        clear += any(item.is_clear for item in mattered.hyperparams if item.name == "train_batch_size")
        (effect,) = (effect for effect in mattered.effects if effect.name == "train_batch_size")
        means.append([level.mean for level in effect.levels])
        assert any("20 trials had not been evaluated by then" in note for note in mattered.notes)
        assert not any("worst" in note for note in mattered.notes)
    assert clear == 0
    of_small, of_large = np.mean(means, axis=0)
    assert abs(of_large - of_small) < 1.0


def test_where_all_were_evaluated_by_then_they_are_judged_by_the_objective() -> None:
    mattered = equal_curves((1024, 2048), objective="best").mattered
    assert mattered.objective == "best"
    assert not any("training episodes" in note for note in mattered.notes)


def test_between_two_evaluations_a_trial_is_on_their_line() -> None:
    rows = [row(600, 10.0, (1.0,)), row(1_000, None, (2.0, 3.0)), row(1_500, 40.0, (4.0, 5.0, 6.0, 7.0, 8.0))]
    cut = rows_until(rows, 1_200)
    assert [(item.num_env_steps, item.evaluation_return) for item in cut] == [(600, 10.0), (1_000, None), (1_200, 30.0)]
    # Two fifths of the iteration, and so of its episodes.
    assert cut[-1].episode_returns == (4.0, 5.0)
    assert cut[:2] == rows[:2]


@pytest.mark.parametrize(
    ("rows", "evaluations"),
    [
        ([row(500, 1.0), row(1_000, 2.0), row(1_500, 9.0)], [1.0, 2.0, None]),  # evaluated just then
        ([row(500, 1.0), row(900, 2.0)], [1.0, 2.0]),  # ended before
        ([row(500, None), row(1_500, 9.0)], [None, None]),  # not evaluated before
        ([row(500, 1.0), row(1_500, None)], [1.0, None]),  # nor after
        ([row(500, 1.0), row(1_500, math.nan), row(2_000, 4.0)], [1.0, 2.0]),
        ([row(4_000, 9.0)], [None]),
        ([], []),
    ],
)
def test_what_is_not_between_two_evaluations_has_none(
    rows: list[IterationRecord], evaluations: list[float | None]
) -> None:
    assert [item.evaluation_return for item in rows_until(rows, 1_000)] == evaluations


def test_of_large_scores_there_is_a_line() -> None:
    assert rows_until([row(500, -1.7e308), row(1_500, 1.7e308)], 1_000)[-1].evaluation_return == 0.0


def test_only_what_failed_counts_as_the_worst_for_it() -> None:
    sweep = equal_curves((1024, 4096))
    sweep = with_trial(sweep, 0, [row(1_024, None, (1.0,))], status="failed")
    solved = [row(1_024, 199.0, (199.0,) * 3)]
    sweep = with_trial(sweep, 2, solved, status="completed", stop_reason="training_return 199")
    sweep = with_trial(sweep, 4, [row(20_000, math.nan)], status="stopped")
    notes = sweep.mattered.notes
    assert "1 trial counted as the worst, having failed." in notes
    assert "1 trial counted as the worst, without a finite return to be judged by." in notes
    (early,) = (note for note in notes if "The scheduler ended" in note)
    assert "All are judged at 10,240 env steps, those that ended before (1 trial) as they were at last" in early
    assert "each of them has done" not in early


def test_who_had_ended_no_episode_by_then_is_left_out() -> None:
    sweep = equal_curves((1024, 4096))
    late = [row(4_096), row(8_192), row(20_480, 150.0, (150.0,))]
    sweep = with_trial(sweep, 1, late, status="completed")
    mattered = sweep.mattered
    assert (mattered.num_points, mattered.num_trials) == (39, 39)
    assert "Left out, as they had ended no episode by then: 1 trial." in mattered.notes
    assert not any("worst" in note for note in mattered.notes)
    rows = {trial_id: [row(20_480, 150.0)] for trial_id in sweep.results}
    assert "No trial showed a score by 10,240 env steps" in dataclasses.replace(sweep, results=rows).mattered.too_few

"""Sweeps whose scores depend on known things, to see what is said of them."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from analysis.importance import Effect, WhatMattered, what_mattered
from analysis.records import IterationRecord, SweepRecord, TrialRecord, TrialStatus

SPACE = {
    "lr": {"loguniform": [1e-5, 1e-1]},
    "activation": {"choice": ["tanh", "relu"]},
    "hidden_sizes": {"choice": [[32], [64, 64]]},
}
Score = Callable[[dict[str, Any]], float]


@dataclasses.dataclass
class Sweep:
    sweep: SweepRecord
    trials: list[TrialRecord]
    results: dict[str, list[IterationRecord]]

    @property
    def mattered(self) -> WhatMattered:
        return what_mattered(self.sweep, self.trials, self.results)


def draw(count: int, seed: int = 0) -> list[dict[str, Any]]:
    rng = np.random.default_rng(seed)
    return [
        {
            "lr": float(10 ** rng.uniform(-5, -1)),
            "activation": str(rng.choice(["tanh", "relu"])),
            "hidden_sizes": [[32], [64, 64]][rng.integers(2)],
        }
        for _ in range(count)
    ]


def sweep_of(
    points: Sequence[dict[str, Any]],
    score: Score,
    *,
    seeds: int = 1,
    noise: float = 1.0,
    space: dict[str, Any] = SPACE,
    status: Callable[[int], TrialStatus] = lambda index: "completed",
    steps: Callable[[int], int] = lambda index: 1000,
    seed: int = 0,
    **spec: Any,
) -> Sweep:
    """A sweep whose trials evaluate to `score` of their points, and noise, at every 100 env steps."""
    rng = np.random.default_rng(seed)
    trials, results = [], {}
    for index in range(len(points) * seeds):
        trial_id, value = f"t{index:04d}", score(points[index // seeds]) + noise * rng.standard_normal()
        results[trial_id] = [
            IterationRecord(iteration=n, num_env_steps=100 * n, num_episodes=n, time_s=1.0, evaluation_return=value)
            for n in range(1, steps(index) // 100 + 1)
        ]
        trials.append(
            TrialRecord(
                trial_id=trial_id, index=index, point_index=index // seeds, seed_index=index % seeds, seed=index,
                point=points[index // seeds], status=status(index), num_env_steps=steps(index),
            )
        )  # fmt: skip
    record = SweepRecord(
        name="s", state="completed", num_trials=len(trials), created_at=0.0, evaluation_seeds=(), confirmation_seeds=(),
        spec={"space": space, "stop": {"num_env_steps": 1000}} | spec,
    )  # fmt: skip
    return Sweep(record, trials, results)


def by_activation(point: dict[str, Any]) -> float:
    return 10.0 if point["activation"] == "tanh" else 0.0


def by_log_lr(point: dict[str, Any]) -> float:
    return -10.0 * (math.log10(point["lr"]) + 3.0) ** 2


def slope_of_log_lr(point: dict[str, Any], slope: float) -> float:
    return slope * math.log10(point["lr"])


def effect_of(mattered: WhatMattered, name: str) -> Effect:
    return next(effect for effect in mattered.effects if effect.name == name)

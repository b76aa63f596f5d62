"""What search methods find on made-up tasks that are as skewed and noisy as returns are; no training, some minutes.

`python -m tests.benchmarks.simulated_search [METHOD,...] [--runs 20] [--at-once 1] [--seeds 3] [--trials 96]` prints
the table of decision 40. A run is a budget of trials, by default 32 points of 3 seeds; a task's best place is drawn for
each run. It counts what the point is worth that a person would take, the one with the best mean over its seeds: the
mean of 1,000 fresh trials of it, as a share of the way from the median of random points to the best place.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from tune_jobs.search.coordinates import Cube
from tune_jobs.search.history import KnownPoint
from tune_jobs.search.proposal import next_point
from tune_jobs.spec.domains import Domain
from tune_jobs.spec.draws import draw_point

Floats = NDArray[np.float64]
PPO: dict[str, Any] = {
    "lr": {"loguniform": [1e-6, 0.1]}, "entropy_coeff": {"uniform": [0, 0.5]}, "gae_lambda": {"uniform": [0.8, 0.9999]},
    "clip_param": {"uniform": [0.01, 0.5]}, "vf_clip_param": {"uniform": [0.01, 0.5]},
    "vf_loss_coeff": {"uniform": [0, 1]}, "grad_clip": {"uniform": [0.01, 1]},
    "minibatch_size": {"choice": [128, 256, 512]}, "normalize_advantages": {"choice": [True, False]},
}  # fmt: skip
DQN: dict[str, Any] = {
    "lr": {"loguniform": [1e-6, 0.1]}, "train_batch_size": {"choice": [64, 128, 256]},
    "replay_capacity": {"lograndint": [1_024, 120_000]}, "activation": {"choice": ["tanh", "relu", "silu", "elu"]},
    "hidden_sizes": {"choice": [[32], [64], [64, 64], [128, 128]]}, "gamma": {"quniform": [0.9, 0.99, 0.01]},
    "initial_epsilon": {"uniform": [0.5, 1]}, "final_epsilon": {"uniform": [0.001, 0.2]},
    "learning_starts": {"qrandint": [0, 2_048, 64]}, "target_network_update_freq": {"randint": [1, 100]},
}  # fmt: skip
Noisy = Callable[[float, float, np.random.Generator, int], Floats]
"""Scores of trials: of how good the place is, from 0 to 1, how far its lr is above the best, generator and number."""


def _ceiling(good: float, above: float, rng: np.random.Generator, number: int) -> Floats:
    """Return scores that end at 500, as CartPole's; worse places collapse in some seeds."""
    learnt = np.minimum(500.0, 700.0 * good * np.exp(0.3 * rng.normal(size=number)))
    kept = np.where(rng.random(number) < 0.4 * (1 - good), rng.random(number), 1.0)
    return np.asarray(np.maximum(9.0, learnt * kept))


def _cliff(good: float, above: float, rng: np.random.Generator, number: int) -> Floats:
    """Return scores that are -200 nearly everywhere, as MountainCar's."""
    solved = rng.random(number) < np.clip((good - 0.3) * 2.0, 0.0, 1.0)
    return np.asarray(np.where(solved, -200.0 + 100.0 * good + 4.0 * rng.normal(size=number), -200.0))


def _diverging(good: float, above: float, rng: np.random.Generator, number: int) -> Floats:
    """Return costs, as Pendulum's, which are unbounded where the lr is too high; some of these trials fail."""
    costs = -150.0 - 1_400.0 * (1.0 - good) ** 1.5 + 40.0 * rng.normal(size=number)
    if above >= 0.2:
        costs -= np.exp(rng.normal(7.0, 2.0, size=number))
        costs = np.where(rng.random(number) < 0.3, np.nan, costs)
    return np.asarray(costs)


def _noisy(good: float, above: float, rng: np.random.Generator, number: int) -> Floats:
    """Return scores with a long tail of bad seeds, as LunarLander's."""
    crashes = np.where(rng.random(number) < 0.25, rng.exponential(150.0, size=number), 0.0)
    return np.asarray(-250.0 + 500.0 * good - crashes + 50.0 * rng.normal(size=number))


def _steady(good: float, above: float, rng: np.random.Generator, number: int) -> Floats:
    """Return scores of many good places, as Acrobot's."""
    return np.asarray(-75.0 - 425.0 * (1.0 - good**0.5) ** 1.5 + 8.0 * rng.normal(size=number))


TASKS: Mapping[str, tuple[dict[str, Any], float, Noisy]] = {
    "ceiling PPO": (PPO, 1.0, _ceiling),
    "cliff DQN": (DQN, 0.7, _cliff),
    "cliff PPO": (PPO, 0.7, _cliff),
    "diverging PPO": (PPO, 1.0, _diverging),
    "noisy DQN": (DQN, 1.0, _noisy),
    "noisy PPO": (PPO, 1.5, _noisy),
    "steady DQN": (DQN, 1.5, _steady),
}
"""Of each task: its space, how narrow its best place is, and its scores."""


class Task:
    """A task whose best place is drawn.

    Args:
        name: One of `TASKS`.
        run: The run that it is drawn for.
    """

    def __init__(self, name: str, run: int) -> None:
        space, narrow, self._scores = TASKS[name]
        self.space: dict[str, Domain] = {key: TypeAdapter(Domain).validate_python(item) for key, item in space.items()}
        self._cube = Cube(self.space)
        rng = np.random.default_rng([run, list(TASKS).index(name)])
        sides = self._cube.num_sides
        # The lr matters most, two others much, and the rest a little; values in no order by another amount each.
        self._weights = narrow * np.array([25.0, *rng.permutation([4.0, 4.0, 1.0, 1.0, *[0.2] * (sides - 5)])])
        self._best = np.clip(rng.normal(0.5, 0.22, size=sides), 0.02, 0.98)
        self._losses = [rng.permutation(np.linspace(0.0, 0.5, max(1, parts))) for parts in self._cube.num_unordered]
        # The best lr depends on another value.
        self._slope, self._other = rng.normal(0.0, 0.25), int(rng.integers(1, sides))

    def scores(self, point: Mapping[str, Any], rng: np.random.Generator, number: int) -> Floats:
        """Return what trials of a point reach; NaN: they fail."""
        return self._of(self._cube.units([point])[0], rng, number)

    def _of(self, units: Floats, rng: np.random.Generator, number: int) -> Floats:
        off = units - self._best
        off[0] -= self._slope * off[self._other]
        losses = self._weights * off**2
        for side, parts in enumerate(self._cube.num_unordered):
            if parts:
                losses[side] = self._weights[side] / 4.0 * self._losses[side][min(parts - 1, int(units[side] * parts))]
        return self._scores(float(np.exp(-losses.sum())), float(off[0]), rng, number)

    def ends(self) -> tuple[float, float]:
        """Return what the median of random points is worth, and the best place."""
        best = self._best.copy()
        for side, parts in enumerate(self._cube.num_unordered):
            if parts:
                best[side] = (np.argmin(self._losses[side]) + 0.5) / parts
        best[0] = np.clip(best[0] + self._slope * (best[self._other] - self._best[self._other]), 0.0, 1.0)
        rng = np.random.default_rng(0)
        points = [draw_point(self.space, index, 1_000_000) for index in range(200)]
        worth = [worth_of(self.scores(point, rng, 100)) for point in points]
        return float(np.median(worth)), worth_of(self._of(best, rng, 2_000))


def worth_of(scores: Floats) -> float:
    """Return the mean of scores, of which those that failed are as bad as the worst that did not."""
    if np.isnan(scores).all():
        return -1e6
    return float(np.where(np.isnan(scores), np.nanmin(scores), scores).mean())


def found_by(method: str, name: str, run: int, *, trials: int, seeds: int, at_once: int) -> tuple[float, float]:
    """Return what a method found in a run, from 0, a random point, to 1, the best; and the seconds that it took."""
    task, rng = Task(name, run), np.random.default_rng([run, 7])
    known: list[KnownPoint] = []
    seconds = 0.0
    for index in range(trials // seeds):
        shown = [
            KnownPoint(item.point, is_running=True) if place > index - at_once else item
            for place, item in enumerate(known)
        ]
        begun = time.perf_counter()
        point = next_point(method, task.space, shown, index, seed=run)
        seconds += time.perf_counter() - begun
        scores = [None if np.isnan(score) else float(score) for score in task.scores(point, rng, seeds)]
        known.append(KnownPoint(point, tuple(scores)))
    whole = [item for item in known if item.score is not None]
    best = max(whole or known, key=lambda item: -np.inf if item.score is None else item.score)
    low, high = task.ends()
    worth = worth_of(task.scores(best.point, np.random.default_rng(run), 1_000))
    return max(-1.0, (worth - low) / (high - low)), seconds


def _one(job: tuple[str, str, int, int, int, int]) -> tuple[float, float]:
    method, name, run, trials, seeds, at_once = job
    return found_by(method, name, run, trials=trials, seeds=seeds, at_once=at_once)


def _ranks(found: Floats) -> Floats:
    """Return the rank of each row in each column, 1 for the best; equal ones share theirs."""
    rounded = np.round(found, 3)
    above = (rounded[None, :, :] > rounded[:, None, :]).sum(1)
    same = (rounded[None, :, :] == rounded[:, None, :]).sum(1)
    return np.asarray(above + (same + 1) / 2)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("methods", nargs="?", default="random,tpe,gp,forest")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--trials", type=int, default=96)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--at-once", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1)
    given = parser.parse_args(arguments)
    methods = given.methods.split(",")
    jobs = [
        (method, name, run, given.trials, given.seeds, given.at_once)
        for method in methods for name in TASKS for run in range(given.runs)
    ]  # fmt: skip
    with ProcessPoolExecutor(given.processes) as pool:
        results = np.array(list(pool.map(_one, jobs, chunksize=4)))
    shape = (len(methods), len(TASKS), given.runs)
    found, seconds = results[:, 0].reshape(shape), results[:, 1].reshape(shape)
    ranks = _ranks(found.reshape(len(methods), -1)).reshape(shape)
    print("| method |", " | ".join(TASKS), "| mean | mean rank | ms a point |")
    print("|---|" + "---|" * (len(TASKS) + 3))
    for index, method in enumerate(methods):
        cells = [f"{value:.2f}" for value in found[index].mean(1)]
        error = ranks[index].std() / np.sqrt(ranks[index].size)
        a_point = 1e3 * seconds[index].mean() / (given.trials // given.seeds)
        print(
            f"| {method} |", " | ".join(cells),
            f"| {found[index].mean():.3f} | {ranks[index].mean():.2f} ± {error:.2f} | {a_point:.1f} |",
        )  # fmt: skip


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()

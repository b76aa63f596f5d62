"""Runs of `asha` on stand-ins for the benchmark's tasks, seconds each, to see what a change of its search does.

`python -m tests.benchmarks.search.stand_ins TASK... [--methods asha,gp-asha] [--runs 36]` needs scikit-learn. A
stand-in is a forest for each rung and for the end of a training, fitted to what the benchmark has kept: of the random
points of `asha` what they came to at each rung, of all points what whole trainings came to. To what a forest expects of
a point comes what it was off by for points of which it expects as much, half of the time the same at two rungs. It
counts what the setting that a run names is worth, as the forest expects it: 0 is the median of random settings, 1 the
best half percent of those that were trained.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.search.kept import DATA
from tests.benchmarks.search.pack_trainer import Returns
from tests.benchmarks.search.schedulers import SEARCH_OF_ASHA, asha, random_points
from tests.benchmarks.search.tasks import TASKS, Task
from tune_jobs.search.coordinates import Cube
from tune_jobs.search.parts import Parts

Floats = NDArray[np.float64]


class Rung:
    """What points come to after so many env steps.

    Args:
        columns: Points, shape (num_points, num_columns).
        scores: The mean over the seeds of each, shape (num_points,).
    """

    def __init__(self, columns: Floats, scores: Floats) -> None:
        from sklearn.ensemble import ExtraTreesRegressor

        forest = ExtraTreesRegressor(150, min_samples_leaf=2, bootstrap=True, oob_score=True, random_state=0)
        forest.fit(columns, scores)
        expected = forest.oob_prediction_
        order = np.argsort(expected)
        self._trees = [tree.tree_ for tree in forest.estimators_]
        self.expected: Floats = expected[order]
        self._off = (scores - expected)[order]
        self._ends = float(scores.min()), float(scores.max())
        self.explained = 1.0 - float(np.var(scores - expected) / np.var(scores))
        """Of the variance of scores, the share that follows from the points, by trees that did not see them."""

    def expects(self, columns: Floats) -> Floats:
        """Return what is expected of points, shape (num_points,)."""
        floats = columns.astype(np.float32)
        found: Floats = np.mean([tree.predict(floats)[:, 0] for tree in self._trees], axis=0)
        return found

    def score(self, columns: Floats, share: float) -> float:
        """Return a score of one point.

        Args:
            columns: The point, shape (1, num_columns).
            share: Of what the forest was off by around there, how much is less than what it is off by here.
        """
        expected, half = float(self.expects(columns)[0]), max(10, len(self._off) // 15)
        first = max(0, min(int(np.searchsorted(self.expected, expected)) - half, len(self._off) - 2 * half))
        near = np.sort(self._off[first : first + 2 * half])
        return float(np.clip(expected + near[min(int(share * len(near)), len(near) - 1)], *self._ends))


class StandIn:
    """A stand-in for a task.

    Args:
        task: The task.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self._parts = Parts(task.spec.space)
        self._cube = Cube(self._parts.space)
        whole: defaultdict[str, dict[int, float | None]] = defaultdict(dict)
        for line in (DATA / f"{task.name}.jsonl").read_text().splitlines():
            row = json.loads(line)
            whole[json.dumps(row["point"], sort_keys=True)][row["seed"]] = row["return"]
        found: defaultdict[int, list[tuple[Mapping[str, Any], float]]] = defaultdict(list)
        for line in (DATA / f"{task.name}.whole.jsonl").read_text().splitlines():
            row = json.loads(line)
            if row["method"] == "asha":
                points = list(itertools.islice(random_points(task, row["run"]), len(row["scores"])))
                for name, steps, score, _ in row["told"]:
                    if score is not None and score > -1e30:
                        found[steps].append((points[int(name[1:])], score))
        seeds = [[score for score in each.values() if score is not None] for each in whole.values()]
        usable = [(json.loads(key), each) for key, each in zip(whole, seeds, strict=True) if len(each) > 1]
        found[max(found)] += [(point, float(np.mean(each))) for point, each in usable]
        self.apart = float(np.median([np.std(each, ddof=1) for _, each in usable]))
        """How far the seeds of a point are apart, as deviation."""
        self.rungs = {
            steps: Rung(self.columns([point for point, _ in rows]), np.array([score for _, score in rows]))
            for steps, rows in sorted(found.items())
        }

    def columns(self, points: Sequence[Mapping[str, Any]]) -> Floats:
        """Return what a forest sees of points, shape (num_points, num_columns)."""
        return self._cube.columns(self._cube.units([self._parts.values_of(point) for point in points]))

    @cached_property
    def _scale(self) -> tuple[float, float]:
        end = self.rungs[max(self.rungs)]
        drawn = end.expects(self.columns(list(itertools.islice(random_points(self.task, 12_345), 400))))
        return float(np.median(drawn)), float(np.quantile(end.expected, 0.995))

    def worth(self, points: Sequence[Mapping[str, Any]]) -> Floats:
        """Return what settings are worth, shape (num_points,)."""
        low, high = self._scale
        worth: Floats = (self.rungs[max(self.rungs)].expects(self.columns(points)) - low) / (high - low)
        return worth


class StandInTrainer:
    """A `Trainer` whose returns are a stand-in's.

    Args:
        stand_in: The stand-in.
        number: The run that its noise is drawn for.
    """

    def __init__(self, stand_in: StandIn, number: int) -> None:
        self._stand_in, self._rng = stand_in, np.random.default_rng([number, 99])
        # All rungs have to be whole iterations.
        self._per_iteration = int(np.gcd.reduce(list(stand_in.rungs)))
        self._steps: dict[str, int] = {}
        self._returns: dict[str, Floats] = {}

    def add(self, name: str, point: Mapping[str, Any], seeds: Sequence[int]) -> None:
        """Draw what a point comes to at each rung; see `Trainer`."""
        columns, rng, share = self._stand_in.columns([point]), self._rng, self._rng.random()
        means = [
            rung.score(columns, share if rng.random() < 0.5 else rng.random()) for rung in self._stand_in.rungs.values()
        ]
        off = rng.normal(size=(len(means), len(seeds))) * self._stand_in.apart
        self._returns[name] = np.array(means)[:, None] + off - off.mean(1, keepdims=True)
        self._steps[name] = 0

    def train(self, names: Collection[str]) -> dict[str, int]:
        """Count an iteration; see `Trainer`."""
        for name in names:
            self._steps[name] += self._per_iteration
        return {name: self._steps[name] for name in names}

    def returns(self, names: Sequence[str]) -> dict[str, Returns]:
        """Return what was drawn for the last rung that was reached; see `Trainer`."""
        reached = list(self._stand_in.rungs)
        return {
            name: self._returns[name][sum(steps <= self._steps[name] for steps in reached) - 1].tolist()
            for name in names
        }

    def copy(self, changes: Mapping[str, tuple[str, Mapping[str, Any]]]) -> None:
        """Refuse; see `Trainer`.

        Raises:
            NotImplementedError: Always: what a copy comes to with other values is not known.
        """
        raise NotImplementedError("A stand-in knows points, not schedules.")

    def remove(self, name: str) -> None:
        """Forget a point; see `Trainer`."""
        del self._returns[name], self._steps[name]


def found_by(stand_in: StandIn, method: str, number: int) -> tuple[float, float, int]:
    """Return what the setting that a run names is worth, its score while tuning, and how many points the run tried."""
    found = asha(stand_in.task, number, StandInTrainer(stand_in, number), SEARCH_OF_ASHA[method])
    worth = float(stand_in.worth([found.best[0].point])[0])
    return worth, max(found.scores), len(found.scores)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line for each task and method."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("tasks", nargs="+", choices=sorted(TASKS))
    parser.add_argument("--methods", default=",".join(SEARCH_OF_ASHA))
    parser.add_argument("--runs", type=int, default=36)
    given = parser.parse_args(arguments)
    for name in given.tasks:
        stand_in = StandIn(TASKS[name])
        told = ", ".join(f"{steps:,}: {rung.explained:.2f}" for steps, rung in stand_in.rungs.items())
        print(f"{name}: of the variance follows from the point, by env steps: {told}")
        for method in given.methods.split(","):
            runs = np.array([found_by(stand_in, method, number) for number in range(given.runs)])
            worth, error = runs[:, 0], float(runs[:, 0].std() / np.sqrt(len(runs)))
            print(
                f"  {method}: worth {worth.mean():.3f} ± {error:.3f}, the worst {worth.min():.2f}; "
                f"score while tuning {runs[:, 1].mean():.1f}; {runs[:, 2].mean():.0f} points",
                flush=True,
            )


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()

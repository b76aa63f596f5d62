"""Trainings of the benchmark's tasks: made in packs, on all cores, and kept in a file, so that none is made twice.

A training is a point, a seed, and the mean of 128 greedy episodes at its end. It is made by the packed engine as a
trial is, without Ray: what is measured is what points a method asks for, and these depend on scores alone.
"""

from __future__ import annotations

import itertools
import json
import math
import multiprocessing
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from policies.hyperparams import DQNHyperparams, Hyperparams
from tests.benchmarks.search.pack_trainer import PackTrainer
from tests.benchmarks.search.tasks import Task
from tune_jobs.plan.engine_choice import pack_key
from tune_jobs.plan.points import point_hyperparams

MAX_AT_ONCE = 24
"""Trainings in a pack; more gain little, and one that a kill takes with it is lost."""

COST_OF_UPDATE = 100
"""What an update of DQN takes besides its batch, in rows of a batch."""


@dataclass(frozen=True)
class Wanted:
    """A training to make."""

    point: Mapping[str, Any]
    seed: int

    @property
    def key(self) -> str:
        """What tells it from others."""
        return json.dumps([dict(sorted(self.point.items())), self.seed])


class Trainings:
    """The trainings of one task, in a file of JSON lines.

    Args:
        task: The task.
        file: Where they are kept; it need not exist.
        num_processes: How many packs train at once.
    """

    def __init__(self, task: Task, file: Path, num_processes: int) -> None:
        self._task, self._file, self._num_processes = task, file, num_processes
        self._known: dict[str, float | None] = {}
        self._pool: ProcessPoolExecutor | None = None
        for line in whole_lines(file):
            row = json.loads(line)
            self._known[Wanted(row["point"], row["seed"]).key] = row["return"]

    def __len__(self) -> int:
        """How many are known."""
        return len(self._known)

    def returns(self, wanted: Sequence[Wanted]) -> Iterator[float | None]:
        """Yield each training's mean greedy return, None for one that failed; those that are not known are made."""
        missing = list({item.key: item for item in wanted if item.key not in self._known}.values())
        if missing:
            self._make(missing)
        yield from (self._known[item.key] for item in wanted)

    def close(self) -> None:
        """End the processes that train, and begin no pack that waits."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None

    def _packs(self, missing: Sequence[Wanted]) -> list[list[Wanted]]:
        """Divide trainings among packs that take nearly as long: those that can share a stack stand side by side."""
        hyperparams = {item.key: point_hyperparams(self._task.spec, item.point, 0) for item in missing}
        ordered = sorted(missing, key=lambda item: repr(pack_key(hyperparams[item.key])))
        rounds = math.ceil(len(ordered) / (MAX_AT_ONCE * self._num_processes))
        count = min(rounds * self._num_processes, len(ordered))
        ends = list(itertools.accumulate(_cost(hyperparams[item.key]) for item in ordered))
        packs: list[list[Wanted]] = [[] for _ in range(count)]
        for item, end in zip(ordered, ends, strict=True):
            middle = end - _cost(hyperparams[item.key]) / 2
            packs[int(count * middle / ends[-1])].append(item)
        return [pack for pack in packs if pack]

    def _make(self, missing: Sequence[Wanted]) -> None:
        if self._pool is None:
            # Kept, as a search asks for a few trainings at a time, and each process loads PyTorch first.
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self._num_processes, mp_context=context)
        futures = {
            self._pool.submit(train, self._task, [(dict(item.point), item.seed) for item in pack]): pack
            for pack in self._packs(missing)
        }
        with self._file.open("a") as file:
            for future in as_completed(futures):
                for item, value in zip(futures[future], future.result(), strict=True):
                    self._known[item.key] = value
                    file.write(json.dumps({"point": dict(item.point), "seed": item.seed, "return": value}) + "\n")
                file.flush()


def _cost(hyperparams: Hyperparams) -> float:
    """Return about how long a training of a task takes beside its others.

    An update of DQN's takes as long for itself as for some 100 rows of its batch; PPO trains each of its rows equally
    often whatever the batch.
    """
    return COST_OF_UPDATE + hyperparams.train_batch_size if isinstance(hyperparams, DQNHyperparams) else 1.0


def train(task: Task, wanted: Sequence[tuple[dict[str, Any], int]]) -> list[float | None]:
    """Train a pack and return each member's mean greedy return at its end; None: its weights are no numbers any more.

    Args:
        task: The task.
        wanted: Points and training seeds.

    Raises:
        Exception: Something else went wrong, of which no point is to blame.
    """
    trainer = PackTrainer(task)
    names = [f"t{index:04d}" for index in range(len(wanted))]
    for name, (point, seed) in zip(names, wanted, strict=True):
        trainer.add(name, point, (seed,))
    left = set(names)
    while left:
        left -= {name for name, steps in trainer.train(left).items() if steps >= task.spec.stop.num_env_steps}
    found = trainer.returns(names)
    trainer.close()
    return [found[name][0] for name in names]


def whole_lines(file: Path) -> list[str]:
    """Return the lines of a file of JSON lines that need not exist; one that was not written whole is removed.

    What is written next must not stand behind it.
    """
    if not file.exists():
        return []
    lines, _, unfinished = file.read_text().rpartition("\n")
    if unfinished:
        os.truncate(file, len(lines) + 1 if lines else 0)
    return lines.splitlines()

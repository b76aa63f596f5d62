"""A driver and the loops of its packs, in one process: no Ray, no training; which pack is the next to report is drawn.

A member's weights are a text that says from whose it is made: `t0001@4` are those of t0001 after four iterations.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from policy_factory import make_portable
from scripted_packs import STEPS, make_sweep

from analysis.records import FINISHED, ChangeRecord, TrialRecord
from policies.acting.evaluate import Episodes, Evaluator
from policies.acting.policy import NetworkPolicy, Policy
from policies.portable.file import PortablePolicy
from tune_jobs.plan.engine_choice import PackPlan
from tune_jobs.ray_tune.hyperband import HyperBand
from tune_jobs.ray_tune.pack_driver import PackDriver
from tune_jobs.ray_tune.pack_trainable import PackTrainable
from tune_jobs.ray_tune.population import Population
from tune_jobs.ray_tune.scheduling import Scheduler
from tune_jobs.ray_tune.trainable import TaskReader
from tune_jobs.search.comparisons import comparisons_before
from tune_jobs.search.gains import Evaluations
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.copies import remove_uncounted_copies
from tune_jobs.store.record_keeper import RecordKeeper
from tune_jobs.training.pack_loop import PackLoop
from tune_jobs.training.protocol import IterationStats, TrialTask

PBT: dict[str, Any] = {"type": "pbt", "perturb_every_env_steps": 400, "quantile_fraction": 0.25}
"""With evaluations every 200 env steps, to 1,000: compared at 400 and 800."""

Score = Callable[[str, int], float]
"""Trial and iteration -> evaluation return."""


@functools.cache
def _policy() -> PortablePolicy:
    return make_portable("CartPole-v1", hidden=(2,))


def random_scores(seed: int, num_levels: int = 6) -> Score:
    """Scores with ties, the same for each trial and iteration."""

    def score(trial_id: str, iteration: int) -> float:
        return float(np.random.default_rng([seed, int(trial_id[1:]), iteration]).integers(num_levels))

    return score


class Engine:
    """Members whose iterations are `STEPS` env steps each.

    Args:
        script: Called before each iteration of a member; what it raises is the member's failure.
    """

    def __init__(self, script: Callable[[str, int], None]) -> None:
        self._script = script
        self.tasks: dict[str, TrialTask] = {}
        self.weights: dict[str, str] = {}
        self.iterations: dict[str, int] = {}
        self.trained: list[tuple[str, int, float]] = []
        """Trial, iteration and learning rate, in the order in which they were trained."""
        self.begun: list[tuple[str, str]] = []
        """Trials that were opened, and the weights that they began with."""
        self.moved: Collection[str] = ()

    def add(self, task: TrialTask, checkpoint: Path | None) -> None:
        assert task.trial_id not in self.tasks
        assert task.in_step
        self.tasks[task.trial_id] = task
        self.iterations[task.trial_id] = task.num_iterations
        weights = f"{task.trial_id}@0"
        if checkpoint is not None:
            weights = json.loads((checkpoint / "state.json").read_text())
        self.weights[task.trial_id] = weights
        self.begun.append((task.trial_id, weights))

    def train_iteration(self, held: Collection[str] = ()) -> dict[str, IterationStats | Exception]:
        results: dict[str, IterationStats | Exception] = {}
        for trial_id, task in self.tasks.items():
            if trial_id in held:
                continue
            try:
                self._script(trial_id, self.iterations[trial_id] + 1)
            except ZeroDivisionError as error:
                results[trial_id] = error
                continue
            self.iterations[trial_id] += 1
            self.weights[trial_id] = f"{trial_id}@{self.iterations[trial_id]}"
            self.trained.append((trial_id, self.iterations[trial_id], task.hyperparams["lr"]))
            results[trial_id] = IterationStats(self.iterations[trial_id] * STEPS, ((1.0, 5),))
        return results

    def policy(self, trial_id: str) -> PortablePolicy:
        training = {"trial_id": trial_id, "iteration": self.iterations[trial_id]}
        return dataclasses.replace(_policy(), training=training)

    def save(self, trial_id: str, folder: Path) -> None:
        (folder / "state.json").write_text(json.dumps(self.weights[trial_id]))

    def remove(self, trial_id: str) -> None:
        del self.tasks[trial_id], self.iterations[trial_id], self.weights[trial_id]

    def close(self) -> None:
        pass


class Process:
    """The process of a pack."""

    def __init__(self, packs: Packs, pack_id: str) -> None:
        self.engine = Engine(packs.script)
        self.loop = PackLoop(
            self.engine,
            cast("Evaluator", None),
            packs.evaluate,
            stop_requested=packs.store.stop_requested,
            max_retries=packs.spec.max_retries,
            wait=lambda _: None,
        )
        self.trainable: Any = PackTrainable.__new__(PackTrainable)
        self.trainable._first = self.trainable._told = None
        self.trainable._owner = SimpleNamespace(held=contextlib.nullcontext)
        self.trainable._files = packs.store.pack(pack_id)
        self.trainable._reader = TaskReader(packs.store.place)


class Packs:
    """A sweep that is driven in packs.

    Args:
        folder: Its storage.
        num_trials: Its size.
        score: What evaluations give.
        scheduler: Its section of the sweep file.
        seed: Draws which pack reports next.
        script: See `Engine`.
        num_packs: Packs.
        slots: Members of a pack.
        spec: More of the sweep file.
    """

    def __init__(
        self,
        folder: Path,
        num_trials: int,
        score: Score,
        scheduler: dict[str, Any],
        *,
        seed: int = 0,
        script: Callable[[str, int], None] = lambda trial_id, iteration: None,
        num_packs: int = 2,
        slots: int = 64,
        **spec: Any,
    ) -> None:
        self.score, self.script, self.rng = score, script, np.random.default_rng(seed)
        place = folder / "mine"
        self.store = make_sweep(place, num_trials, scheduler=scheduler, **spec)
        self.spec = SweepSpec.model_validate(self.store.read_record().spec)
        self.num_packs, self.slots = num_packs, slots
        for index in range(num_trials):
            trial = self.store.trial(f"t{index:04d}")
            values = {"lr": 1e-3 + index * 1e-4}
            trial.write_record(trial.read_record().model_copy(update={"point": values, "hyperparams": values}))
        self.begin()

    def begin(self) -> None:
        """Drive it: from its beginning, or from what is on disk."""
        self.todo = todo = [record.trial_id for record in self.store.read_trials() if record.status not in FINISHED]
        for name in todo:
            remove_uncounted_copies(self.store.trial(name), self.store.trial(name).read_record().changes)
        self.keeper = RecordKeeper(self.store, todo, lambda record: None)
        plan = PackPlan(self.num_packs, self.slots, 1.0, 0.0, tuple(todo), "scalar", None, 0)
        self.driver = PackDriver(self.store, self.spec, plan, todo, scheduler=self._scheduler(), keeper=self.keeper)
        self.processes: dict[str, Process] = {}
        self.engines: list[Engine] = []
        for pack_id in self.driver.pack_ids:
            self.starts(pack_id)

    def _scheduler(self) -> Scheduler:
        if self.spec.scheduler.type == "hyperband":
            grace = self.spec.scheduler.grace_env_steps or 1
            return HyperBand(grace, self.spec.stop.num_env_steps, self.spec.scheduler.reduction_factor)
        todo = [self.keeper.record(name) for name in self.todo]
        before = comparisons_before(self.store, self.spec, todo)
        return Population(self.spec, self.keeper.record, self._curves(), self.keeper.all_records, before=before)

    def _curves(self) -> Evaluations | None:
        return Evaluations(self.store) if self.spec.scheduler.type == "pb2" else None

    def population(self) -> Population:
        """Its rule, to which all trials are known and that has compared none."""
        before = comparisons_before(self.store, self.spec, self.keeper.all_records())
        population = Population(self.spec, self.keeper.record, self._curves(), before=before)
        for record in self.keeper.all_records():
            population.begins(record.trial_id)
        return population

    def starts(self, pack_id: str) -> None:
        """Start the process of a pack, for the first time or again."""
        self.driver.started(pack_id)
        self.processes[pack_id] = Process(self, pack_id)
        self.engines.append(self.processes[pack_id].engine)

    def evaluate(self, evaluator: Evaluator, policies: Sequence[Policy]) -> list[Episodes | Exception]:
        told = [cast("NetworkPolicy", policy).portable.training for policy in policies]
        return [Episodes((1,), (self.score(one["trial_id"], one["iteration"]),), (5,)) for one in told]

    def step(self, pack_id: str) -> None:
        """One step of a pack's process, and what the driver makes of its reports."""
        process = self.processes[pack_id]
        process.trainable._arrange(process.loop)
        until_evaluated = self.spec.scheduler.type == "hyperband"
        reports = process.loop.advance(float(self.rng.choice([0.0, 1e9])), until_evaluated=until_evaluated)
        if self.driver.take(pack_id, reports, node="here", pid=1, tell=process.trainable.assign):
            self.driver.closed(pack_id)
            del self.processes[pack_id]

    def run(self, until: Callable[[], bool] = lambda: False, most: int = 2_000) -> Packs:
        """Until nothing is left to do, or something is so."""
        for _ in range(most):
            if self.driver.is_finished or until():
                self.keeper.close()
                return self
            self.step(str(self.rng.choice(list(self.processes))))
        raise AssertionError(f"It does not end: {[(one.trial_id, one.status) for one in self.records()]}")

    def records(self) -> list[TrialRecord]:
        return self.keeper.all_records()

    def has_reached(self, num_env_steps: int) -> bool:
        """Whether any trial has."""
        return any(record.num_env_steps >= num_env_steps for record in self.records())

    def changes(self) -> dict[str, list[ChangeRecord]]:
        """What was changed, without the times at which it was."""
        return {
            record.trial_id: [change.model_copy(update={"time": 0.0}) for change in record.changes]
            for record in self.records()
        }

    def curves(self) -> dict[str, list[tuple[int, float | None]]]:
        return {
            record.trial_id: [
                (one.num_env_steps, one.evaluation_return)
                for one in self.store.trial(record.trial_id).read_iterations()
            ]
            for record in self.records()
        }

    def begun(self) -> list[tuple[str, str]]:
        return [one for engine in self.engines for one in engine.begun]

    def trained(self) -> list[tuple[str, int, float]]:
        return [one for engine in self.engines for one in engine.trained]

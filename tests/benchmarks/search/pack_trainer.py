"""Trains points with several seeds each in one pack, of the packed engine, without Ray and without a sweep's files."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from analysis.records import ChangeRecord
from policies.errors import NonFiniteWeightsError
from tests.benchmarks.search.tasks import Task
from tune_jobs.plan.points import point_hyperparams
from tune_jobs.spec.sections import CheckpointSpec, EvaluationSpec, StopSpec

if TYPE_CHECKING:
    from tune_jobs.training.protocol import TrialTask

ENVS = "tests.benchmarks.search.envs"
"""The module of the environments that a task may name."""
Returns = Sequence[float | None]
"""Of each seed of a point the mean return of greedy episodes; None: its weights are no numbers any more."""


class Trainer(Protocol):
    """Trains points by their names, each with seeds of its own; what one does has no effect on the others."""

    def add(self, name: str, point: Mapping[str, Any], seeds: Sequence[int]) -> None:
        """Add a point, untrained."""
        ...

    def train(self, names: Collection[str]) -> dict[str, int]:
        """Train some points for one iteration of each seed, and return the env steps that a seed has trained."""
        ...

    def returns(self, names: Sequence[str]) -> dict[str, Returns]:
        """Play greedy episodes with what some points have learnt by now."""
        ...

    def copy(self, changes: Mapping[str, tuple[str, Mapping[str, Any]]]) -> None:
        """Let points go on from copies, each seed from the same place among the seeds of the other.

        Args:
            changes: By name, the name of the point to copy, as it is before all of these copies, and the new values.
        """
        ...

    def remove(self, name: str) -> None:
        """Forget a point."""
        ...


class PackTrainer:
    """The `Trainer` of the benchmark: a pack of this process.

    Args:
        task: What is trained.
        in_step: Whether all points are always as far as each other, as in a population.
    """

    def __init__(self, task: Task, *, in_step: bool = False) -> None:
        from policies.acting.evaluate import Evaluator
        from policies.envs.modules import allow_modules
        from tune_jobs.training.packed import PackedEngine

        allow_modules([ENVS])
        self._task, self._in_step = task, in_step
        self._engine = PackedEngine()
        self._evaluator = Evaluator(task.evaluation_env_id, task.spec.env.wrapped_args, task.evaluation_seeds)
        self._members: dict[str, list[str]] = {}
        self._tasks: dict[str, TrialTask] = {}

    def add(self, name: str, point: Mapping[str, Any], seeds: Sequence[int]) -> None:
        """Add a point, untrained."""
        self._members[name] = [f"{name}-{seed}" for seed in seeds]
        for member, seed in zip(self._members[name], seeds, strict=True):
            self._tasks[member] = self._trial(member, point, seed)
            self._engine.add(self._tasks[member], None)

    def _trial(self, member: str, point: Mapping[str, Any], seed: int) -> TrialTask:
        from tune_jobs.training.protocol import TrialTask

        spec = self._task.spec
        return TrialTask(
            sweep_place=".",
            trial_id=member,
            # As far apart as the training seeds of a sweep.
            seed=1024 * seed,
            algorithm=spec.algorithm,
            hyperparams=self._hyperparams(point),
            env_id=spec.env.id,
            env_args=spec.env.wrapped_args,
            stop=StopSpec(),
            evaluation=EvaluationSpec(),
            checkpoints=CheckpointSpec(),
            evaluation_seeds=(0,),
            in_step=self._in_step,
        )

    def _hyperparams(self, point: Mapping[str, Any]) -> dict[str, Any]:
        values: dict[str, Any] = point_hyperparams(self._task.spec, dict(point), 0).model_dump(mode="json")
        return values

    def train(self, names: Collection[str]) -> dict[str, int]:
        """Train some points for one iteration; see `Trainer`.

        Raises:
            Exception: Something went wrong of which no point is to blame.
        """
        held = {member for name, members in self._members.items() if name not in names for member in members}
        steps: dict[str, int] = {}
        for member, stats in self._engine.train_iteration(held).items():
            if isinstance(stats, Exception):
                raise stats
            steps[member] = stats.num_env_steps
            task = self._tasks[member]
            self._tasks[member] = replace(
                task, num_env_steps=stats.num_env_steps, num_iterations=task.num_iterations + 1
            )
        return {name: steps[self._members[name][0]] for name in names}

    def returns(self, names: Sequence[str]) -> dict[str, Returns]:
        """Play greedy episodes with what some points have learnt by now; see `Trainer`.

        Raises:
            Exception: An environment failed.
        """
        from policies.acting.evaluate import Episodes
        from policies.acting.load import policy_from_portable
        from policies.packed.evaluation import evaluate_many

        members = [member for name in names for member in self._members[name]]
        acting = [policy_from_portable(self._engine.policy(member)) for member in members]
        found: dict[str, float | None] = {}
        for member, episodes in zip(members, evaluate_many(self._evaluator, acting), strict=True):
            if isinstance(episodes, Episodes):
                found[member] = episodes.mean_return
            elif isinstance(episodes, NonFiniteWeightsError):
                found[member] = None
            else:
                raise episodes
        return {name: [found[member] for member in self._members[name]] for name in names}

    def copy(self, changes: Mapping[str, tuple[str, Mapping[str, Any]]]) -> None:
        """Let points go on from copies, as a population's trials do; see `Trainer`."""
        with tempfile.TemporaryDirectory() as folder:
            for source in {source for source, _ in changes.values()}:
                for member in self._members[source]:
                    self._engine.save(member, Path(folder) / member)
            for name, (source, point) in changes.items():
                for member, other in zip(self._members[name], self._members[source], strict=True):
                    self._tasks[member] = self._changed(self._tasks[member], point)
                    self._engine.remove(member)
                    self._engine.add(self._tasks[member], Path(folder) / other)

    def _changed(self, task: TrialTask, point: Mapping[str, Any]) -> TrialTask:
        # The engine asks of a change only that there was one: a checkpoint of other values is refused otherwise.
        change = ChangeRecord(
            iteration=task.num_iterations, num_env_steps=task.num_env_steps, source_trial_id="t0000",
            source_iteration=task.num_iterations, before={}, after=dict(point), time=0.0,
        )  # fmt: skip
        return replace(task, hyperparams=self._hyperparams(point), changes=(*task.changes, change))

    def remove(self, name: str) -> None:
        """Forget a point."""
        for member in self._members.pop(name):
            self._engine.remove(member)
            del self._tasks[member]

    def close(self) -> None:
        """Close the environments."""
        self._engine.close()

"""Runs of methods that look at trainings before their end, by the product's own rules.

`asha` with random points and with those of a model, and populations: `pbt`, `mf-pbt` and `pb2`.

All that trains does so side by side and equally fast, so that the order in which the rules are asked depends on returns
alone. A point's seeds train in step, and the rules are told the mean over them, as ARLBench tells its optimisers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from analysis.records import ChangeRecord, TrialRecord
from tests.benchmarks.search.pack_trainer import Returns, Trainer
from tests.benchmarks.search.runs import mean_or_worst
from tests.benchmarks.search.tasks import TEST_SEEDS, TUNING_SEEDS, Task
from tune_jobs.plan.points import point_hyperparams
from tune_jobs.search.gains import Score
from tune_jobs.search.history import KnownPoint
from tune_jobs.search.proposal import next_point
from tune_jobs.search.rungs import Passed
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.scheduler import SchedulerSpec
from tune_jobs.store.transitions import with_change

if TYPE_CHECKING:
    from tune_jobs.ray_tune.scheduling import Standing

SEARCH_OF_ASHA = {"asha": "random", "gp-asha": "gp"}
"""The `search.type` that goes with it, by method."""
SCHEDULERS = (*SEARCH_OF_ASHA, "pbt", "mf-pbt", "pb2")
"""The methods whose runs are here."""
MF_PBT = {"type": "pbt", "frequencies": [1, 3]}
"""Two sub-populations. The slower one is compared three times in ten intervals; with the paper's 5 it would be once."""
NUM_AT_ONCE = 8
"""Points that `asha` trains side by side: with their seeds, a pack."""


@dataclass(frozen=True)
class Stage:
    """Values that a training has from so many env steps on."""

    from_env_steps: int
    point: Mapping[str, Any]


@dataclass
class Tuned:
    """What a run has found, before its best is tested."""

    scores: list[float]
    """Of each point or member the mean over its seeds at the end of its training; -inf: a seed failed, or the training
    was ended early."""
    schedules: list[list[Stage]]
    """What each was trained with, in the same order."""
    num_env_steps: list[int]
    """What each has trained, all seeds together, in the same order."""
    told: list[tuple[str, int, float, str]] = field(default_factory=list)
    """What the rule was asked, and what it decided: name, env steps, score; and of `asha` the decision, of a population
    the member whose copy it goes on from."""

    @property
    def best(self) -> list[Stage]:
        """The schedule of the highest score; of equals the first."""
        return self.schedules[self.scores.index(max(self.scores))]


def task_of(task: Task, method: str, number: int) -> Task:
    """Return a task as a run trains it: that of a population is the sweep that a user would launch.

    What can't be changed within a trial, or is not in the space of ARLBench's PBT, is fixed: there is a target network,
    which theirs fixes too; the first update comes after 128 env steps, their default; the replay memory holds a
    training, as theirs does.
    """
    if method in SEARCH_OF_ASHA:
        return task
    data = task.spec.model_dump(mode="json", exclude_defaults=True)
    dqn = {"target_network": True, "learning_starts": 128, "replay_capacity": task.spec.stop.num_env_steps}
    fixed = {name: value for name, value in dqn.items() if name in data["space"]}
    space = {name: domain for name, domain in data["space"].items() if name not in fixed}
    for domain in space.values():
        # It acts in all points, where its condition is on a value that is fixed so.
        if all(name in fixed for name in domain.get("when", {})):
            domain.pop("when", None)
    changes = {
        "space": space, "hyperparams": data["hyperparams"] | fixed, "seed": number,
        "scheduler": MF_PBT if method == "mf-pbt" else {"type": method},
        "seeds_per_point": 1, "evaluation": {"every_iterations": 1}, "checkpoints": {"every_iterations": 1},
    }  # fmt: skip
    return task.with_spec(load_spec(data | changes))


def tuned(task: Task, method: str, number: int, trainer: Trainer) -> Tuned:
    """Run one optimiser, without the test of what it found.

    Args:
        task: What `task_of` returned.
        method: One of `SCHEDULERS`.
        number: The run's number, which is the seed of its draws.
        trainer: Trains the task.
    """
    if method in SEARCH_OF_ASHA:
        return asha(task, number, trainer, SEARCH_OF_ASHA[method])
    return population(task, trainer)


def random_points(task: Task, number: int) -> Iterator[dict[str, Any]]:
    """Yield the points that the random search tries in a run of this number, and more."""
    index, spec = 0, task.spec
    while True:
        yield next_point(
            "random", spec.space, [], index, seed=number, check=lambda point: point_hyperparams(spec, point, None)
        )
        index += 1


def replayed(task: Task, schedule: Sequence[Stage], seeds: Sequence[int], trainer: Trainer) -> Returns:
    """Train with a schedule from the start, on other seeds, and return what each has at its end.

    Where a member of the population went on from a copy with other values, so does this training, from itself.
    """
    name, steps, later = "t0000", 0, list(schedule[1:])
    trainer.add(name, schedule[0].point, seeds)
    while steps < task.spec.stop.num_env_steps:
        if later and steps >= later[0].from_env_steps:
            trainer.copy({name: (name, later.pop(0).point)})
        steps = trainer.train([name])[name]
    return trainer.returns([name])[name]


def tested(task: Task, schedule: Sequence[Stage], trainer: Trainer) -> float:
    """Return the mean over the test seeds; -inf if one failed."""
    return mean_or_worst(replayed(task, schedule, TEST_SEEDS, trainer))


class _Asha:
    """A run of successive halving (Li et al. 2020): points are tried until the env steps are spent.

    The budget is that of 32 whole points, to the env step. A place that gets free is taken by a new point at once, as
    long as what is left brings it and all that train to their ends; the last one trains with what remains.
    """

    def __init__(self, task: Task, number: int, trainer: Trainer, search: str) -> None:
        from tune_jobs.ray_tune.early_stopping import build_scheduler, grace_env_steps

        scheduler = SchedulerSpec(type="asha")
        self._task, self._trainer = task, trainer
        self._cap = task.spec.stop.num_env_steps
        self._rule = build_scheduler(scheduler, self._cap)
        self._first_rung, self._factor = grace_env_steps(scheduler, self._cap), scheduler.reduction_factor
        self._search, self._number = search, number
        self._points: list[dict[str, Any]] = []
        self._steps: dict[str, int] = {}
        """Env steps that a seed of each point has trained, in the order in which they began."""
        self._rungs: dict[str, float] = {}
        """The next rung of each point that trains."""
        self._scores: dict[str, float] = {}
        self._ended: dict[str, KnownPoint] = {}
        """What a model is told of each point that does not train any more."""
        self._passed: dict[str, list[Passed]] = {}
        """What each point that trains had come to at the rungs that it passed."""
        self._told: list[tuple[str, int, float, str]] = []
        self._per_iteration = 0
        self._left = 0
        """Env steps of a seed that are left, once the first iteration has told how long they are."""

    def run(self) -> Tuned:
        self._begin()
        while self._rungs:
            self._count(self._trainer.train(list(self._rungs)))
            self._decide([name for name in self._rungs if self._is_due(name)])
            if not self._left:
                break
            self._begin()
        unit = len(TUNING_SEEDS)
        return Tuned(
            [self._scores.get(name, mean_or_worst([None])) for name in self._steps],
            [[Stage(0, point)] for point in self._points],
            [unit * steps for steps in self._steps.values()],
            self._told,
        )

    def _begin(self) -> None:
        """Fill the free places, as far as what is left brings all that train to their ends."""
        while len(self._rungs) < min(NUM_AT_ONCE, self._task.spec.num_samples):
            if self._per_iteration and not self._is_enough_for_another():
                return
            name = f"t{len(self._points):04d}"
            self._points.append(self._next_point())
            self._trainer.add(name, self._points[-1], TUNING_SEEDS)
            self._rule.begins(name)
            self._steps[name], self._rungs[name] = 0, self._first_rung

    def _next_point(self) -> dict[str, Any]:
        spec, names = self._task.spec, list(self._steps)
        known = [
            self._ended.get(name, KnownPoint(point, is_running=True))
            for name, point in zip(names, self._points, strict=True)
        ]
        return next_point(
            self._search, spec.space, known, len(known), seed=self._number,
            num_startup_trials=spec.search.num_startup_trials, check=lambda point: point_hyperparams(spec, point, None),
        )  # fmt: skip

    def _is_enough_for_another(self) -> bool:
        if not self._rungs:
            # The last ones train with what remains.
            return self._left > 0
        needed = sum(self._whole - self._steps[name] for name in self._rungs)
        return needed + self._whole <= self._left

    @property
    def _whole(self) -> int:
        return -(-self._cap // self._per_iteration) * self._per_iteration

    def _count(self, steps: Mapping[str, int]) -> None:
        if not self._per_iteration:
            self._per_iteration = next(iter(steps.values()))
            self._left = self._task.spec.num_samples * self._whole
        for name, reached in steps.items():
            if reached != self._steps[name] + self._per_iteration:
                raise RuntimeError(f"An iteration of {name} was {reached - self._steps[name]} env steps long.")
            self._left -= self._per_iteration
            self._steps[name] = reached

    def _is_due(self, name: str) -> bool:
        return self._steps[name] >= min(self._rungs[name], self._cap)

    def _decide(self, due: Sequence[str]) -> None:
        from tune_jobs.ray_tune.scheduling import Decision, NobodyWaits

        returns = self._trainer.returns(due) if due else {}
        for name in due:
            score, steps = mean_or_worst(returns[name]), self._steps[name]
            standing = _standing(name, steps, score)
            has_ended = steps >= self._cap
            decision = Decision.STOP if has_ended else self._rule.reached(standing, NobodyWaits())
            self._told.append((name, steps, standing.score, "end" if has_ended else str(decision)))
            if has_ended:
                self._scores[name] = score
            if decision is Decision.STOP:
                self._rule.ended(standing)
                level = None if has_ended else int(math.log(steps / self._first_rung, self._factor) + 1e-9)
                self._ended[name] = KnownPoint(
                    self._points[int(name[1:])], tuple(returns[name]), level=level, trained=min(1.0, steps / self._cap),
                    passed=() if None in returns[name] else tuple(self._passed.get(name, ())),
                )  # fmt: skip
                self._trainer.remove(name)
                del self._rungs[name]
                continue
            self._passed.setdefault(name, []).append(Passed(steps / self._cap, score))
            while self._rungs[name] <= steps:
                self._rungs[name] *= self._factor


def asha(task: Task, number: int, trainer: Trainer, search: str = "random") -> Tuned:
    """Run successive halving, with the points that a search method chooses; see `_Asha`."""
    return _Asha(task, number, trainer, search).run()


def _standing(name: str, num_env_steps: int, score: float) -> Standing:
    from tune_jobs.ray_tune.scheduling import WORST_SCORE, Standing

    return Standing(name, num_env_steps, max(score, WORST_SCORE), evaluated=True)


class _NobodyEnded:
    """The other trials of a population none of whose members ends before the last."""

    def wait(self) -> bool:
        return False

    def ended(self) -> Sequence[str]:
        return ()


def population(task: Task, trainer: Trainer) -> Tuned:
    """Run population based training, by the scheduler of the task's sweep: 32 members of three seeds each."""
    from tune_jobs.ray_tune.population import Population
    from tune_jobs.ray_tune.scheduling import CopyFrom, is_unscored

    spec = task.spec
    records = {
        f"t{index:04d}": TrialRecord(
            trial_id=f"t{index:04d}", index=index, point_index=index, seed=0, point=point, status="running"
        )
        for index, point in zip(range(spec.num_samples), random_points(task, spec.seed), strict=False)
    }
    curves: dict[str, list[Score]] = {name: [] for name in records}
    scheduler = Population(spec, records.__getitem__, (lambda _: curves) if spec.scheduler.type == "pb2" else None)
    schedules = {name: [Stage(0, record.point)] for name, record in records.items()}
    told: list[tuple[str, int, float, str]] = []
    for name, record in records.items():
        scheduler.begins(name)
        trainer.add(name, record.point, TUNING_SEEDS)
    iteration, steps, cap = 0, 0, spec.stop.num_env_steps
    while steps < cap:
        reached = trainer.train(records)
        iteration += 1
        if len(set(reached.values())) > 1:
            raise RuntimeError(f"Members of a population are apart: {sorted(set(reached.values()))} env steps.")
        steps = next(iter(reached.values()))
        if steps >= cap or steps < scheduler.due_at("t0000"):
            continue
        scores = {name: mean_or_worst(returns) for name, returns in trainer.returns(list(records)).items()}
        standings = [_standing(name, steps, score) for name, score in scores.items()]
        for standing in standings:
            if not is_unscored(standing.score):
                curves[standing.trial_id].append(Score(iteration, steps, standing.score))
        outcomes = scheduler.compared(standings, _NobodyEnded())
        copies = {name: outcome for name, outcome in outcomes.items() if isinstance(outcome, CopyFrom)}
        told += [
            (one.trial_id, steps, one.score, copies[one.trial_id].trial_id if one.trial_id in copies else "")
            for one in standings
        ]
        trainer.copy({name: (copy.trial_id, copy.point) for name, copy in copies.items()})
        # All from those of before: a member that is copied from may be one that goes on from another's copy.
        schedules |= {name: [*schedules[copy.trial_id], Stage(steps, copy.point)] for name, copy in copies.items()}
        for name, copy in copies.items():
            records[name] = _with_copy(records[name], copy.trial_id, copy.point, iteration, steps)
    scores = {name: mean_or_worst(returns) for name, returns in trainer.returns(list(records)).items()}
    return Tuned(list(scores.values()), list(schedules.values()), [len(TUNING_SEEDS) * steps] * len(records), told)


def _with_copy(record: TrialRecord, source: str, point: dict[str, Any], iteration: int, steps: int) -> TrialRecord:
    change = ChangeRecord(
        iteration=iteration, num_env_steps=steps, source_trial_id=source, source_iteration=iteration,
        before=record.point, after=point, time=0.0,
    )  # fmt: skip
    return with_change(record, change, record.hyperparams)

"""The benchmark of the search: methods that look at trainings before their end, with trainings that are a formula."""

import functools
import itertools
import json
import math
import statistics
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from analysis.records import ChangeRecord, TrialRecord
from tests.benchmarks.search import whole_runs as module
from tests.benchmarks.search.pack_trainer import PackTrainer
from tests.benchmarks.search.runs import mean_or_worst
from tests.benchmarks.search.schedulers import (
    MF_PBT,
    NUM_AT_ONCE,
    SCHEDULERS,
    Stage,
    Tuned,
    random_points,
    replayed,
    task_of,
    tuned,
)
from tests.benchmarks.search.tables import tables, values_of
from tests.benchmarks.search.tasks import TASKS, TEST_SEEDS, TUNING_SEEDS, Task
from tests.benchmarks.search.trainings import train
from tests.benchmarks.search.whole_runs import WholeRuns, row_of, run_of
from tune_jobs.ray_tune.early_stopping import build_scheduler
from tune_jobs.ray_tune.population import Population
from tune_jobs.ray_tune.scheduling import CopyFrom, Decision, NobodyWaits, Standing
from tune_jobs.search.gains import Score
from tune_jobs.spec.scheduler import SchedulerSpec
from tune_jobs.store.transitions import with_change

pytestmark = pytest.mark.ray
TASK = TASKS["cartpole-ppo"]
PER_ITERATION = 2_048
WHOLE = 49 * PER_ITERATION


def rise_by_lr(point: Mapping[str, Any], steps: int) -> float:
    """What an iteration gains: the best learning rate falls while it trains; a large one ruins the weights."""
    if point["lr"] > 0.05:
        return math.nan
    return 2 - abs(math.log10(point["lr"]) + 2 + 2 * steps / WHOLE)


class Formula:
    """A `Trainer` whose weights are one number a seed, to which each iteration adds what its values gain."""

    def __init__(self) -> None:
        self.points: dict[str, Mapping[str, Any]] = {}
        self.steps: dict[str, int] = {}
        self.weights: dict[str, list[float]] = {}
        self.trained = 0
        self.most = 0
        self.seeds: set[int] = set()

    def add(self, name: str, point: Mapping[str, Any], seeds: Sequence[int]) -> None:
        assert name not in self.points
        self.points[name], self.steps[name] = point, 0
        self.weights[name] = [0.001 * seed for seed in seeds]
        self.seeds |= set(seeds)
        self.most = max(self.most, len(self.points))

    def train(self, names: Collection[str]) -> dict[str, int]:
        for name in names:
            gained = rise_by_lr(self.points[name], self.steps[name])
            self.weights[name] = [weight + gained for weight in self.weights[name]]
            self.steps[name] += PER_ITERATION
            self.trained += PER_ITERATION * len(self.weights[name])
        return {name: self.steps[name] for name in names}

    def returns(self, names: Sequence[str]) -> dict[str, Sequence[float | None]]:
        return {name: [None if math.isnan(one) else one for one in self.weights[name]] for name in names}

    def copy(self, changes: Mapping[str, tuple[str, Mapping[str, Any]]]) -> None:
        before = {name: list(weights) for name, weights in self.weights.items()}
        for name, (source, point) in changes.items():
            assert self.steps[name] == self.steps[source]
            self.points[name], self.weights[name] = point, before[source]

    def remove(self, name: str) -> None:
        del self.points[name], self.weights[name]


SEARCH = TASK.spec.search.model_copy(update={"num_startup_trials": 2})
SMALL = TASK.with_spec(TASK.spec.model_copy(update={"num_samples": 8, "search": SEARCH}))


def task_for(method: str, number: int = 0) -> Task:
    """Models take seconds for as many points as the benchmark has."""
    return task_of(SMALL if method in {"pb2", "gp-asha"} else TASK, method, number)


def made(method: str, number: int) -> tuple[Tuned, Formula]:
    trainer = Formula()
    return tuned(task_for(method, number), method, number, trainer), trainer


played = functools.cache(made)


@pytest.mark.parametrize(
    ("method", "number"), [("asha", 0), ("asha", 1), ("asha", 2), ("gp-asha", 0), ("pbt", 0), ("mf-pbt", 0), ("pb2", 0)]
)
def test_a_run_trains_as_many_env_steps_as_those_of_the_other_methods(method: str, number: int) -> None:
    found, trainer = played(method, number)
    num_points = task_for(method).spec.num_samples
    assert num_points == (8 if method in {"pb2", "gp-asha"} else 32)
    assert trainer.trained == sum(found.num_env_steps) == num_points * len(TUNING_SEEDS) * WHOLE
    assert trainer.seeds == set(TUNING_SEEDS)
    assert max(found.scores) > -math.inf
    assert len(found.scores) == len(found.schedules) == len(found.num_env_steps)
    # Nothing has trained for longer than one training.
    assert max(found.num_env_steps) == len(TUNING_SEEDS) * WHOLE


@pytest.mark.parametrize("method", SCHEDULERS)
def test_a_run_is_the_same_again_and_begins_with_the_points_of_the_random_search(method: str) -> None:
    found, again = played(method, 0)[0], made(method, 0)[0]
    assert found == again
    assert found.schedules != made(method, 2)[0].schedules
    first, drawn = [schedule[0].point for schedule in found.schedules], random_points(TASK, 0)
    if method == "asha":
        assert first == [next(drawn) for _ in first]
        assert len(first) > 60
    elif method == "gp-asha":
        points = [next(drawn) for _ in first]
        # The model waits for two whole trainings of points that ended, most of which did so at the first rung.
        num_random = next(index for index, point in enumerate(first) if point != points[index])
        assert len(first) > num_random + 5
        units = [steps / len(TUNING_SEEDS) / WHOLE for steps in found.num_env_steps]
        ended = [units[index] for index in range(num_random)]
        assert SEARCH.num_startup_trials <= sum(ended)
        assert num_random > 10
        assert all(point not in points for point in first[-5:])
    else:
        points = [next(drawn) for _ in first]
        assert all(point in points for point in first)


def test_asha_decides_as_the_rule_does_and_has_all_places_taken() -> None:
    found, trainer = played("asha", 0)
    rule, known = build_scheduler(SchedulerSpec(type="asha"), TASK.spec.stop.num_env_steps), set()
    for name, steps, score, told in found.told:
        standing = Standing(name, steps, score, evaluated=True)
        if name not in known:
            known.add(name)
            rule.begins(name)
        if told == "end":
            assert steps == WHOLE
            rule.ended(standing)
            continue
        decision = rule.reached(standing, NobodyWaits())
        assert told == str(decision)
        if decision is Decision.STOP:
            rule.ended(standing)
    # Those that get somewhere together are asked about in the order in which they began.
    assert [name for name, *_ in found.told[:NUM_AT_ONCE]] == [f"t{index:04d}" for index in range(NUM_AT_ONCE)]
    assert trainer.most == NUM_AT_ONCE
    # At most the last one is not trained until it is ended or whole.
    last = {name: (steps, told) for name, steps, _, told in found.told}
    unfinished = [name for index, name in enumerate(sorted(last)) if 3 * last[name][0] != found.num_env_steps[index]]
    assert len(unfinished) + len(found.scores) - len(last) <= 1
    # The rungs of the product: 1/20 of a training, and three times as far.
    assert {steps for _, steps, _, _ in found.told} == {3 * 2_048, 8 * 2_048, 22 * 2_048, WHOLE}
    finished = [score for score in found.scores if score > -math.inf]
    assert len(finished) == sum(told == "end" for *_, told in found.told)
    assert found.best[0].point == found.schedules[found.scores.index(max(finished))][0].point


def test_asha_ends_what_is_ruined_and_a_failed_point_is_never_the_best() -> None:
    found, _ = played("asha", 0)
    ruined = [index for index, schedule in enumerate(found.schedules) if schedule[0].point["lr"] > 0.05]
    assert ruined
    assert all(found.scores[index] == -math.inf for index in ruined)
    told = {name: steps for name, steps, score, _ in found.told if score < -1e299}
    assert set(told.values()) == {3 * 2_048}


@pytest.mark.parametrize("method", ["pbt", "mf-pbt", "pb2"])
def test_a_population_is_compared_as_the_products_is(method: str) -> None:
    found, _ = played(method, 0)
    spec = task_for(method).spec
    assert spec.scheduler == SchedulerSpec.model_validate(MF_PBT if method == "mf-pbt" else {"type": method})
    drawn = random_points(TASK, 0)
    records = {
        f"t{index:04d}": TrialRecord(
            trial_id=f"t{index:04d}", index=index, point_index=index, seed=0, point=next(drawn), status="running"
        )
        for index in range(spec.num_samples)
    }
    curves: dict[str, list[Score]] = {name: [] for name in records}
    product = Population(spec, records.__getitem__, (lambda _: curves) if method == "pb2" else None)
    for name in records:
        product.begins(name)
    times = sorted({steps for _, steps, _, _ in found.told})
    assert len(times) == 9
    num_copies = 0
    for steps in times:
        asked = [(name, score, source) for name, at, score, source in found.told if at == steps]
        assert [name for name, _, _ in asked] == list(records)
        for name, score, _ in asked:
            if score > -1e299:
                curves[name].append(Score(steps // PER_ITERATION, steps, score))
        assert steps >= product.due_at("t0000") > steps - PER_ITERATION
        outcomes = product.compared(
            [Standing(name, steps, score, evaluated=True) for name, score, _ in asked], _Nobody()
        )
        copies = {name: outcome for name, outcome in outcomes.items() if isinstance(outcome, CopyFrom)}
        assert {name: outcome.trial_id for name, outcome in copies.items()} == {
            name: source for name, _, source in asked if source
        }
        num_copies += len(copies)
        for name, copy in copies.items():
            change = ChangeRecord(
                iteration=steps // PER_ITERATION, num_env_steps=steps, source_trial_id=copy.trial_id,
                source_iteration=steps // PER_ITERATION, before=records[name].point, after=copy.point, time=0.0,
            )  # fmt: skip
            records[name] = with_change(records[name], change, {})
    assert num_copies > spec.num_samples
    assert [schedule[-1].point for schedule in found.schedules] == [record.point for record in records.values()]


class _Nobody:
    def wait(self) -> bool:
        return False

    def ended(self) -> Sequence[str]:
        return ()


@pytest.mark.parametrize("method", ["pbt", "mf-pbt", "pb2"])
def test_a_members_schedule_is_what_its_weights_were_trained_with(method: str) -> None:
    found, _ = played(method, 0)
    assert max(map(len, found.schedules)) > 3
    for score, schedule in zip(found.scores, found.schedules, strict=True):
        assert [stage.from_env_steps for stage in schedule] == sorted({stage.from_env_steps for stage in schedule})
        again = mean_or_worst(replayed(TASK, schedule, TUNING_SEEDS, Formula()))
        assert again == pytest.approx(score)
    trainer = Formula()
    replayed(TASK, found.best, TEST_SEEDS, trainer)
    assert trainer.seeds == set(TEST_SEEDS)
    assert trainer.trained == len(TEST_SEEDS) * WHOLE
    # Those that gain nothing are copied over.
    first = itertools.islice(random_points(TASK, 0), len(found.scores))
    alone = [mean_or_worst(replayed(TASK, [Stage(0, point)], TUNING_SEEDS, Formula())) for point in first]
    assert statistics.median(found.scores) > statistics.median(alone) + 5
    if method != "mf-pbt":
        # Of two halves, one may have kept the very best of these as it was.
        assert max(found.scores) > max(
            mean_or_worst(replayed(TASK, schedule[:1], TUNING_SEEDS, Formula())) for schedule in found.schedules
        )


def test_a_population_whose_members_are_apart_is_refused() -> None:
    class Apart(Formula):
        def train(self, names: Collection[str]) -> dict[str, int]:
            return super().train(names) | {"t0003": 5}

    with pytest.raises(RuntimeError, match=r"Members of a population are apart: \[5, 2048\] env steps"):
        tuned(task_for("pbt"), "pbt", 0, Apart())
    with pytest.raises(RuntimeError, match="An iteration of t0003 was 5 env steps long"):
        tuned(TASK, "asha", 0, Apart())


def _row(method: str, number: int) -> dict[str, Any]:
    return row_of(method, number, Tuned([1.0, -math.inf], [[Stage(0, {"lr": number})]] * 2, [3, 1]), 0.5)


class InThisProcess(ThreadPoolExecutor):
    def __init__(self, num_processes: int, mp_context: Any) -> None:
        super().__init__(1)


def test_no_run_is_made_twice_whenever_the_benchmark_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "ProcessPoolExecutor", InThisProcess)
    made: list[tuple[str, int]] = []

    def make(task: Task, method: str, number: int) -> dict[str, Any]:
        assert task is TASK
        if len(made) == 3:
            raise MemoryError
        made.append((method, number))
        return _row(method, number)

    file = tmp_path / "whole.jsonl"
    with pytest.raises(MemoryError):
        WholeRuns(TASK, file, 2, make).runs(["asha", "pbt"], 2)
    assert made == [("asha", 0), ("asha", 1), ("pbt", 0)]
    kept = file.read_text()
    # Killed once more, while the last line was written.
    file.write_text(kept + '{"method": "pbt", "run"')
    made[:2] = []
    found = WholeRuns(TASK, file, 2, make).runs(["asha", "pbt"], 2)
    assert made == [("pbt", 0), ("pbt", 1)]
    assert file.read_text().startswith(kept)
    assert list(found) == [("asha", 0), ("asha", 1), ("pbt", 0), ("pbt", 1)]
    assert found["asha", 1].best == {"lr": 1}
    assert WholeRuns(TASK, file, 2, make).runs(["pbt"], 1) == {("pbt", 0): found["pbt", 0]}


def test_a_run_is_kept_with_its_schedules_and_failures_as_null() -> None:
    stages = [Stage(0, {"lr": 0.1}), Stage(512, {"lr": 0.2})]
    row = json.loads(json.dumps(row_of("pbt", 0, Tuned([-math.inf, 2.0], [stages[:1], stages], [1, 1]), -math.inf)))
    assert (row["scores"], row["test"], row["best"]) == ([None, 2.0], None, 1)
    found = run_of(row)
    assert found.scores == (-math.inf, 2.0)
    assert found.test == -math.inf
    assert found.best == {
        "schedule": [{"from_env_steps": 0, "point": {"lr": 0.1}}, {"from_env_steps": 512, "point": {"lr": 0.2}}]
    }


def test_tables_have_a_column_for_each_method_that_has_runs_and_ranks_of_those_that_have_all() -> None:
    def kept(*values: float) -> dict[str, Any]:
        made = {"date": "2026-11-23", "machine": "a machine"}
        return {"runs": [{**made, "scores": [value], "best": {}, "test": value} for value in values]}

    first, second = "cartpole-ppo", "pendulum-ppo"
    found = {(task, method): kept(1, 2) for task in (first, second) for method in ("random", "gp")}
    text = "\n".join(tables({**found, (first, "pbt"): kept(3, 4), (second, "asha"): None}))
    assert "| task | random | gp | pbt | ARLBench: random |" in text
    assert "| pendulum-ppo | 1.5 ± 6.4 (of 2) | 1.5 ± 6.4 (of 2) |  | -873 |" in text
    assert "asha" not in text
    assert "Mean rank of 2 over 2 tasks, while tuning: random 1.50, gp 1.50" in text
    assert "Mean rank of 3 over 1 task, while tuning: random 2.50, gp 2.50, pbt 1.00" in text
    # A method that has run one task takes no rank from those that have run both.
    text = "\n".join(tables({**found, (first, "tpe"): kept(0, 0)}))
    assert "Mean rank of 2 over 2 tasks, while tuning: random 1.50, gp 1.50" in text
    assert "Mean rank of 3 over 1 task, while tuning: random 1.50, gp 1.50, tpe 3.00" in text
    assert values_of(kept(1, 2), "score") == [1, 2]


def short(task: Task) -> Task:
    stop = task.spec.stop.model_copy(update={"num_env_steps": 2_500})
    shorter = {"env_steps_per_iteration": 256} if task.spec.algorithm == "dqn" else {}
    changes = {"num_samples": 4, "stop": stop, "hyperparams": task.spec.hyperparams | shorter}
    return task.with_spec(task.spec.model_copy(update=changes))


def test_a_point_of_asha_is_trained_as_one_by_itself() -> None:
    small = short(TASK)
    trainer = PackTrainer(small)
    found = tuned(small, "asha", 0, trainer)
    trainer.close()
    assert sum(found.num_env_steps) == 4 * 3 * 10 * 256
    assert len(found.scores) > 5
    returns = train(small, [(dict(found.best[0].point), seed) for seed in TUNING_SEEDS])
    assert mean_or_worst(returns) == max(found.scores)


@pytest.mark.parametrize("name", ["cartpole-ppo", "cartpole-dqn"])
def test_a_replayed_schedule_gives_what_the_population_gave_to_the_bit(name: str) -> None:
    """A member's seeds are those that its copies have, too, so the way of its weights can be gone again."""
    small = task_of(short(TASKS[name]), "pbt", 0)
    trainer = PackTrainer(small, in_step=True)
    found = tuned(small, "pbt", 0, trainer)
    trainer.close()
    assert sum(found.num_env_steps) == 4 * 3 * 10 * 256
    longest = max(range(4), key=lambda index: len(found.schedules[index]))
    assert len(found.schedules[longest]) > 2
    again = PackTrainer(small)
    assert mean_or_worst(replayed(small, found.schedules[longest], TUNING_SEEDS, again)) == found.scores[longest]
    again.close()


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_a_populations_task_is_one_that_the_product_launches(task: Task) -> None:
    spec = task_of(task, "pbt", 3).spec
    assert (spec.num_samples, spec.seeds_per_point, spec.seed) == (32, 1, 3)
    # As in ARLBench: ten intervals of 32 members.
    assert spec.perturb_every_env_steps == task.spec.stop.num_env_steps // 10
    fixed = {"target_network": True, "learning_starts": 128, "replay_capacity": spec.stop.num_env_steps}
    left_out = set(task.spec.space) - set(spec.space)
    assert left_out == (set(fixed) if spec.algorithm == "dqn" else set())
    assert spec.hyperparams == task.spec.hyperparams | {name: fixed[name] for name in left_out}
    if spec.algorithm == "dqn":
        assert spec.space["prioritized_alpha"] == task.spec.space["prioritized_alpha"]
        assert spec.space["target_update_freq"].when is None
    assert task_of(task, "asha", 3) is task

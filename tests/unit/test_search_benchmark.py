"""The benchmark of the search, with trainings that are a formula."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Generator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from policy_factory import make_portable

from policies.acting.evaluate import evaluate_policy
from policies.acting.policy import NetworkPolicy
from policies.envs import modules as env_modules
from policies.portable.network import Layer, PolicyNetwork
from tests.benchmarks.search import confirmed_runs, envs
from tests.benchmarks.search import trainings as module
from tests.benchmarks.search.all_runs import run_all
from tests.benchmarks.search.kept import DATA
from tests.benchmarks.search.pack_trainer import ENVS
from tests.benchmarks.search.runs import METHODS, Run, mean_or_worst, run
from tests.benchmarks.search.same_task import AnotherTaskError, check_same_task
from tests.benchmarks.search.tables import tables
from tests.benchmarks.search.tasks import TASKS, TEST_SEEDS, TUNING_SEEDS, Task
from tests.benchmarks.search.trainings import Trainings, Wanted
from tune_jobs.search.proposal import next_point

TASK = TASKS["cartpole-ppo"]
Formula = Callable[[Mapping[str, Any], int], float | None]
Runner = Callable[[Task, str, int], Generator[list[Wanted], list[float | None], Run]]


def lr_is_best_at_a_thousandth(point: Mapping[str, Any], seed: int) -> float | None:
    """Higher is better; the seed adds a little."""
    return None if point["lr"] > 0.05 else -abs(math.log10(point["lr"]) + 3) + 0.001 * seed


def played(
    method: str, number: int, formula: Formula = lr_is_best_at_a_thousandth, task: Task = TASK, runner: Runner = run
) -> tuple[Run, list[list[Wanted]]]:
    """A run whose trainings are the formula, and what it asked for at each time."""
    generator, asked = runner(task, method, number), []
    wanted = next(generator)
    while True:
        asked.append(wanted)
        try:
            wanted = generator.send([formula(item.point, item.seed) for item in wanted])
        except StopIteration as end:
            return end.value, asked


@pytest.mark.parametrize("method", ["random", "tpe"])
def test_a_run_is_32_points_of_three_seeds_and_the_best_on_five_others(method: str) -> None:
    found, asked = played(method, 1)
    tuned = [item for wanted in asked[:-1] for item in wanted]
    assert len(tuned) == 32 * len(TUNING_SEEDS)
    assert [item.seed for item in tuned] == list(TUNING_SEEDS) * 32
    assert [item.seed for item in asked[-1]] == list(TEST_SEEDS)
    assert not set(TEST_SEEDS) & set(TUNING_SEEDS)
    assert {json.dumps(item.point) for item in asked[-1]} == {json.dumps(found.best)}
    assert found.score == max(found.scores) == pytest.approx(-abs(math.log10(found.best["lr"]) + 3) + 0.001)
    assert found.test == pytest.approx(-abs(math.log10(found.best["lr"]) + 3) + 0.102)
    # A failed seed is below everything.
    assert [score == -math.inf for score in found.scores] == [item.point["lr"] > 0.05 for item in tuned[::3]]


def test_a_run_is_the_same_again_and_another_number_is_another_run() -> None:
    first, asked = played("tpe", 0)
    again, asked_again = played("tpe", 0)
    assert (first, asked) == (again, asked_again)
    assert played("tpe", 1)[1] != asked
    # The model comes after ten random points, which are those of the random search.
    drawn = [item.point for item in played("random", 0)[1][0]]
    assert [item.point for item in asked[0]] == drawn[:30]
    assert len(asked) == 1 + 22 + 1
    assert asked[1][0].point != drawn[30]


@pytest.mark.parametrize("method", METHODS)
def test_what_does_not_act_is_not_in_a_point(method: str) -> None:
    _, asked = played(method, 0, task=TASKS["cartpole-dqn"])
    points = [item.point for wanted in asked for item in wanted]
    for name, parent, value in (
        ("target_update_freq", "target_network", True),
        ("prioritized_alpha", "replay", "prioritized"),
    ):
        assert {name in point for point in points} == {True, False}
        assert all((name in point) is (point[parent] == value) for point in points)


def test_a_seed_that_failed_makes_its_point_the_worst() -> None:
    assert mean_or_worst([1.0, 2.0]) == 1.5
    assert mean_or_worst([1.0, None]) == -math.inf
    assert mean_or_worst([1.0, math.nan]) == -math.inf


def test_no_training_is_made_twice_whenever_the_benchmark_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []
    limit = 40

    def make(self: Trainings, missing: list[Wanted]) -> None:
        with self._file.open("a") as file:
            for item in missing:
                if len(made) == limit:
                    raise KeyboardInterrupt
                made.append(item.key)
                self._known[item.key] = value = lr_is_best_at_a_thousandth(item.point, item.seed)
                file.write(json.dumps({"point": dict(item.point), "seed": item.seed, "return": value}) + "\n")

    monkeypatch.setattr(Trainings, "_make", make)
    with pytest.raises(KeyboardInterrupt):
        run_all(TASK, Trainings(TASK, tmp_path / "made.jsonl", 1), ["random", "tpe"], 2)
    limit = 10**6
    found = run_all(TASK, Trainings(TASK, tmp_path / "made.jsonl", 1), ["random", "tpe"], 2)
    assert len(made) == len(set(made))
    assert {name: item for name, item in found.items() if name[1] == 0} == {
        ("random", 0): played("random", 0)[0], ("tpe", 0): played("tpe", 0)[0],
    }  # fmt: skip


def test_trainings_of_another_task_file_are_not_taken_for_those_of_this(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "edited.yaml"
    file.write_text(TASK.file.read_text())
    monkeypatch.setattr(Task, "file", file)
    for _ in range(2):
        check_same_task(TASK, tmp_path)
    file.write_text(
        file.read_text().replace("CartPole-v1, 100,000", "another title").replace("gamma: 0.99", "gamma: 0.9")
    )
    with pytest.raises(AnotherTaskError, match=r"hyperparams is .*'gamma': 0\.9,.*, was .*'gamma': 0\.99,.* remove"):
        check_same_task(TASK, tmp_path)


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_the_data_of_every_task_are_of_its_task_file(task: Task) -> None:
    assert (DATA / f"{task.name}.task.json").exists()
    check_same_task(task, DATA)


@pytest.mark.parametrize(("wanted", "sizes"), [(1, [1]), (3, [1, 2]), (48, [24, 24]), (60, [15] * 4)])
def test_packs_are_of_one_size_and_of_trainings_that_share_stacks(
    tmp_path: Path, wanted: int, sizes: list[int]
) -> None:
    task = TASKS["pendulum-ppo"]
    points = [next_point("random", task.spec.space, [], index, seed=0) for index in range(wanted)]
    missing = [Wanted(point, 0) for point in points]
    packs = Trainings(task, tmp_path / "made.jsonl", 2)._packs(missing)
    assert sorted(map(len, packs)) == sizes
    assert sorted(item.key for pack in packs for item in pack) == sorted(item.key for item in missing)
    in_order = [item.point["minibatch_size"] for pack in packs for item in pack]
    assert len([size for size, _ in itertools.groupby(in_order)]) == len(set(in_order))


def test_packs_of_dqn_take_nearly_as_long_as_their_batches_say(tmp_path: Path) -> None:
    task = TASKS["acrobot-dqn"]
    point = next_point("random", task.spec.space, [], 0, seed=0)
    missing = [
        Wanted(point | {"train_batch_size": size, "lr": 0.001 * (place + 1)}, seed)
        for place, size in enumerate((64, 256, 64, 64, 256, 64))
        for seed in TUNING_SEEDS
    ]

    def rows(pack: list[Wanted]) -> int:
        return sum(module.COST_OF_UPDATE + item.point["train_batch_size"] for item in pack)

    first, second = Trainings(task, tmp_path / "made.jsonl", 2)._packs(missing)
    assert sorted(item.key for item in (*first, *second)) == sorted(item.key for item in missing)
    assert abs(rows(first) - rows(second)) <= module.COST_OF_UPDATE + 256
    assert sorted(map(len, (first, second))) == [6, 12]


def test_a_line_that_was_not_written_whole_is_made_again(tmp_path: Path) -> None:
    file = tmp_path / "made.jsonl"
    whole = json.dumps({"point": {"lr": 0.5}, "seed": 1, "return": 2.0}) + "\n"
    for unfinished in ('{"point": {"lr": 0.', '{"point": {"lr": 0.25}, "seed": 1, "return": 3.0}'):
        for before in ("", whole):
            file.write_text(before + unfinished)
            assert len(Trainings(TASK, file, 1)) == (before != "")
            assert file.read_text() == before


def test_what_no_point_is_to_blame_for_is_no_failed_training(monkeypatch: pytest.MonkeyPatch) -> None:
    from tune_jobs.training.packed import PackedEngine

    monkeypatch.setattr(PackedEngine, "train_iteration", lambda *_: {"t0000-0": OSError("the disk is full")})
    with pytest.raises(OSError, match="the disk is full"):
        module.train(TASK, [({"lr": 1e-3, "minibatch_size": 128}, 0)])


def kept(*values: float) -> dict[str, Any]:
    made = {"date": "2026-11-23", "machine": "a machine"}
    return {"runs": [{**made, "scores": [value - 1, value], "best": {}, "test": value - 2} for value in values]}


def test_ranks_leave_out_a_task_that_a_method_has_run_less_often() -> None:
    found = {
        ("cartpole-dqn", "random"): kept(1, 2), ("cartpole-dqn", "pbt"): kept(5, 1),
        ("acrobot-dqn", "random"): kept(1, 2), ("acrobot-dqn", "pbt"): kept(5),
    }  # fmt: skip
    lines = list(tables(found))
    assert "| acrobot-dqn | 1.5 ± 6.4 (of 2) | 5.0 (of 1) |" in "\n".join(lines)
    assert [line for line in lines if line.startswith("Mean rank")] == [
        "Mean rank of 2 over 1 task, while tuning: random 1.50, pbt 1.50; on test seeds: random 1.50, pbt 1.50."
    ]


def test_a_method_with_few_runs_of_a_task_takes_that_from_no_others() -> None:
    whole, few = kept(1, 2), kept(3)
    found = {(task, name): whole for task in ("cartpole-dqn", "acrobot-dqn") for name in ("random", "tpe", "pbt")}
    found |= {("cartpole-dqn", "asha"): whole, ("acrobot-dqn", "asha"): few}
    lines = list(tables(found))
    assert [line.partition(",")[0] for line in lines if line.startswith("Mean rank")] == [
        "Mean rank of 2 over 2 tasks", "Mean rank of 3 over 2 tasks", "Mean rank of 4 over 1 task",
    ]  # fmt: skip


def test_methods_that_have_run_all_tasks_are_ranked_where_each_task_has_one_more() -> None:
    found = {(task, name): kept(1, 2) for task in ("cartpole-dqn", "acrobot-dqn") for name in ("random", "tpe", "pbt")}
    found |= {("cartpole-dqn", "asha"): kept(1, 2), ("acrobot-dqn", "pb2"): kept(1, 2)}
    assert [line.partition(",")[0] for line in tables(found) if line.startswith("Mean rank")] == [
        "Mean rank of 2 over 2 tasks", "Mean rank of 3 over 2 tasks", "Mean rank of 4 over 1 task",
        "Mean rank of 4 over 1 task",
    ]  # fmt: skip


def test_the_default_is_ranked_beside_random_draws_wherever_both_were_run() -> None:
    found = {("cartpole-dqn", "random"): kept(1, 2), ("cartpole-dqn", "gp"): kept(5, 1)}
    text = "\n".join(tables({**found, ("acrobot-dqn", "gp"): kept(5, 5), ("acrobot-dqn", "tpe"): kept(5, 5)}))
    assert "Mean rank of 2 over 1 task, while tuning: random 1.50, gp 1.50" in text


def test_the_tables_show_means_intervals_and_ranks() -> None:
    text = "\n".join(tables({("cartpole-dqn", "random"): kept(1, 2, 3), ("cartpole-dqn", "tpe"): kept(5, 5, 2)}))
    # The t distribution's 97.5 % quantile with 2 degrees of freedom is 4.303; the deviations are 1 and 1.732.
    assert "| cartpole-dqn | 2.0 ± 2.5 (of 3) | 4.0 ± 4.3 (of 3) | 485.7 | 500 | 466.7 | 421.3 |" in text
    assert "| cartpole-dqn | 0.0 ± 2.5 (of 3) | 2.0 ± 4.3 (of 3) |" in text
    assert "while tuning: random 1.67, tpe 1.33" in text


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_every_task_is_as_the_published_ones(task: Task) -> None:
    spec = task.spec
    assert (spec.num_samples, spec.seeds_per_point) == (32, len(TUNING_SEEDS))
    assert len(task.evaluation_seeds) == 128
    assert spec.hyperparams["hidden_sizes"] == [64, 64]
    assert spec.space["lr"].model_dump() == {"loguniform": (1e-6, 0.1)}


@pytest.mark.ray
def test_a_training_is_that_of_a_pack_and_a_failed_one_is_none() -> None:
    """One training of 256 env steps beside one whose learning rate ruins it."""
    data = TASK.spec.model_dump(mode="json", exclude_defaults=True) | {"stop": {"num_env_steps": 512}}
    small = _small(data)
    point = {"lr": 1e-3, "minibatch_size": 128}
    ruined = {"lr": 1e30, "minibatch_size": 128}
    first, second, third = module.train(small, [(point, 0), (ruined, 0), (point, 1)])
    assert first is not None
    assert third is not None
    assert 8 <= first <= 500
    assert first != third
    assert second is None
    assert module.train(small, [(point, 0)]) == [first]


def _small(data: dict[str, Any]) -> Task:
    from tune_jobs.spec.file import load_spec

    small = Task("small", {})
    vars(small)["spec"] = load_spec(data)
    return small


def test_the_time_limit_of_mountain_car_is_an_end() -> None:
    env = envs.make()
    env.reset(seed=0)
    ends = [env.step(1)[2:4] for _ in range(200)]
    assert ends == [(False, False)] * 199 + [(True, False)]
    assert (
        TASKS["mountaincar-dqn"].spec.env.id
        == f"{envs.__name__}:EndingMountainCar-v0"
        == f"{ENVS}:EndingMountainCar-v0"
    )


def test_the_greedy_episodes_of_mountain_car_are_those_of_the_env_that_is_played_all_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A policy that pushes where the car goes reaches the goal, at another step for each seed."""
    monkeypatch.setattr(env_modules, "_allowed", {ENVS})
    task = TASKS["mountaincar-dqn"]
    assert task.evaluation_env_id == "MountainCar-v0"
    q_values = Layer(np.array([[0, -1], [0, 0], [0, 1]], np.float32), np.array([0, -0.01, 0], np.float32), "linear")
    portable = replace(make_portable("MountainCar-v0"), network=PolicyNetwork("q_values", (q_values,)))
    seeds = task.evaluation_seeds[:16]
    ours, theirs = (
        evaluate_policy(NetworkPolicy(portable), env_id=env_id, seeds=seeds, env_args=task.spec.env.wrapped_args)
        for env_id in (task.evaluation_env_id, task.spec.env.id)
    )
    assert ours == theirs
    assert len(set(ours.returns)) > 3
    assert max(ours.returns) > -180


def first_seed_flatters(point: Mapping[str, Any], seed: int) -> float | None:
    """What is far from the best has luck with its first seed, and fails with its second."""
    score = -abs(math.log10(point["lr"]) + 3)
    if score < -1.5:
        return 5.0 if seed % 10_000 < 82 else None
    return score + 0.01 * ((seed * 7) % 3)


@pytest.mark.parametrize("method", list(confirmed_runs.CONFIRMED))
def test_a_run_with_confirm_makes_as_many_trainings_and_names_no_lucky_setting(method: str) -> None:
    found, asked = played(method, 1, first_seed_flatters, runner=confirmed_runs.run)
    trained = [item for wanted in asked[:-1] for item in wanted]
    searched, raced = trained[:82], trained[82:]
    assert len(searched) == len(found.scores) == 82
    assert 0 < len(raced) <= 14
    assert {json.dumps(item.point) for item in raced} <= {json.dumps(item.point) for item in searched}
    # Each has a seed of its own, and none is one of those that judge.
    assert len({item.seed for item in trained}) == len(trained)
    assert not {item.seed for item in trained} & set(TEST_SEEDS)
    assert [item.seed for item in asked[-1]] == list(TEST_SEEDS)
    # The five leading ones are all of those that had luck; what is named is none that failed after it.
    assert max(found.scores[:82]) == 5.0
    assert {json.dumps(item.point) for item in asked[-1]} == {json.dumps(found.best)}
    best = next(index for index, item in enumerate(searched) if item.point == found.best)
    assert found.scores[best] != -math.inf


def test_settings_with_more_seeds_are_ranked_by_what_is_expected_of_them() -> None:
    returns: list[list[float | None]] = [[4.0, 1.0, 1.0], [3.0, 3.1, 2.9], [2.0], [None], [2.0]]
    assert confirmed_runs.ranked(returns)[0] == 1
    assert confirmed_runs.finite_scores(returns)[3] == (1.0,)
    assert confirmed_runs.ranked([[None], [1.0], [1.0]]) == [1, 2, 0]


def test_tables_have_runs_with_confirm_on_test_seeds_alone() -> None:
    def kept(score: float, test: float) -> dict[str, Any]:
        return {"runs": [{"date": "2026-01-01", "machine": "one", "scores": [score], "test": test}] * 5}

    found = {("cartpole-ppo", "random"): kept(500.0, 400.0), ("cartpole-ppo", "gp"): kept(500.0, 410.0)}
    without = list(tables(found))
    lines = list(tables({**found, ("cartpole-ppo", "gp-confirm"): kept(480.0, 470.0)}))
    first, second = (index for index, line in enumerate(lines) if line.startswith("| task |"))
    assert "gp-confirm" not in lines[first]
    assert lines[second] == "| task | random | gp | gp-confirm |"
    assert lines[second + 2] == "| cartpole-ppo | 400.0 ± 0.0 | 410.0 ± 0.0 | 470.0 ± 0.0 |"
    assert [line for line in lines if line.startswith("Mean rank") and line not in without] == [
        "Mean rank of 3 over 1 task, on test seeds: random 3.00, gp 2.00, gp-confirm 1.00."
    ]

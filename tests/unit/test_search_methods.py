"""The search methods that have a model, on trials that take no time: the score is a function of the point."""

import builtins
import importlib.util
import json
import math
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import pytest

from analysis.records import TrialRecord
from analysis.selection import score_trial
from policies.errors import CannotRunError, SpecError
from tests.narrowing import present
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.search.history import History, known_points
from tune_jobs.search.proposal import propose_point
from tune_jobs.spec.draws import draw_point
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec

METHODS = [
    pytest.param(method, marks=pytest.mark.skipif(importlib.util.find_spec(needs) is None, reason=f"needs {needs}"))
    for method, needs in (("gp", "scipy"), ("forest", "sklearn"), ("tpe", "optuna"))
]
each_method = pytest.mark.parametrize("method", METHODS)
SPACE = {"lr": {"loguniform": [1e-5, 1e-1]}, "activation": {"choice": ["tanh", "relu", "silu"]}}


def make_spec(num_samples: int = 40, startup: int = 8, method: str = "tpe", **changes: Any) -> SweepSpec:
    search = {"type": method, "num_startup_trials": startup}
    base = {"env": "CartPole-v1", "algorithm": "ppo", "space": SPACE, "num_samples": num_samples, "search": search}
    return load_spec({**base, **changes})


def valley(point: dict[str, Any]) -> float:
    """Best, 0, at lr 1e-3 with silu."""
    return cast("float", -abs(math.log10(point["lr"]) + 3) - (point["activation"] != "silu"))


def record(
    index: int,
    point: dict[str, Any],
    score: float | None = None,
    *,
    status: str = "completed",
    point_index: int | None = None,
    steps: int = 200_000,
) -> TrialRecord:
    point_index = index if point_index is None else point_index
    kept = {"trial_id": f"t{index:04d}", "iteration": 1, "num_env_steps": steps, "evaluation_return": score}
    return TrialRecord(
        trial_id=f"t{index:04d}", index=index, point_index=point_index, seed=index, point=point, hyperparams={"lr": 1},
        status=status, best_evaluation_return=score, num_env_steps=steps, checkpoints=[kept],
    )  # fmt: skip


def search(spec: SweepSpec, score: Callable[[dict[str, Any]], float], *, at_once: int = 1) -> list[dict[str, Any]]:
    """All points of a sweep, `at_once` trials running at a time."""
    records: list[Any] = []
    for index in range(spec.num_samples):
        point = propose_point(spec, records, index, lambda point: None)
        records.append(record(index, point, status="running"))
        if index >= at_once - 1:
            done = index - at_once + 1
            records[done] = record(done, records[done].point, score(records[done].point))
    return [item.point for item in records]


@each_method
@pytest.mark.parametrize("at_once", [1, 4])
def test_later_points_concentrate_where_scores_are_better_than_those_of_random_ones(method: str, at_once: int) -> None:
    gains, silu = [], []
    for seed in range(3):
        spec = make_spec(seed=seed, method=method)
        points = search(spec, valley, at_once=at_once)[20:]
        random = [draw_point(spec.space, index, spec.seed) for index in range(20, 40)]
        gains.append(np.mean([valley(p) for p in points]) - np.mean([valley(p) for p in random]))
        silu.append(np.mean([p["activation"] == "silu" for p in points]))
    # A random point scores -1.7 in the mean; none scores above 0.
    assert min(gains) > 0.5
    assert np.mean(silu) > 0.55


@each_method
def test_points_are_the_planned_random_ones_until_enough_have_ended(method: str) -> None:
    spec = make_spec(method=method, startup=8)
    points = search(spec, valley)
    plan = make_plan(spec, Machine(num_cpus=2))
    assert points[:8] == [trial.point for trial in plan.trials[:8]]
    assert points[8] != draw_point(spec.space, 8, spec.seed)


@each_method
def test_the_same_records_give_the_same_point_whatever_ran_before(method: str) -> None:
    spec = make_spec(method=method)
    points = search(spec, valley)[:12]
    records = [record(index, point, valley(point)) for index, point in enumerate(points)]
    again = [TrialRecord.model_validate(json.loads(item.model_dump_json())) for item in records]
    first = propose_point(spec, records, 12, lambda point: None)
    assert propose_point(spec, again, 12, lambda point: None) == first
    assert propose_point(make_spec(method=method, seed=1), records, 12, lambda point: None) != first
    assert propose_point(spec, records, 13, lambda point: None) != first


@each_method
def test_trials_that_run_at_the_same_time_are_kept_apart(method: str) -> None:
    spec = make_spec(method=method, startup=4, space={"lr": SPACE["lr"]})
    ended = [record(index, {"lr": lr}, valley({"lr": lr, "activation": "silu"})) for index, lr in enumerate(
        [1e-5, 1e-4, 9e-4, 1e-3, 1.1e-3, 1e-2, 1e-1])]  # fmt: skip
    # By the same random numbers, as the forest draws a fifth of its points.
    alone = [propose_point(spec, ended, 13 + k, lambda point: None)["lr"] for k in range(12)]
    running = [record(7 + k, {"lr": lr}, status="running") for k, lr in enumerate(alone[:6])]
    beside = [propose_point(spec, ended + running, 13 + k, lambda point: None)["lr"] for k in range(12)]

    def far(values: Sequence[float]) -> np.float64:
        """How far each is from the nearest that runs, in powers of ten."""
        apart = np.log10(values)[:, None] - np.log10(alone[:6])[None, :]
        return cast("np.float64", np.abs(apart).min(axis=1).mean())

    assert beside != alone
    # Trees are flat around what they know, so that the forest, which is told of these, still looks close to them.
    assert method == "forest" or far(beside) > 3 * far(alone[6:])


@each_method
@pytest.mark.parametrize(
    "bad",
    [
        {"status": "failed", "score": 100.0},
        {"status": "failed", "score": None},
        {"status": "completed", "score": None},
        {"status": "stopped", "score": -50.0, "steps": 20_000},
    ],
)
def test_points_that_failed_were_not_scored_or_were_ended_early_are_avoided(method: str, bad: dict[str, Any]) -> None:
    spec = make_spec(method=method, startup=4, space={"lr": {"uniform": [0.001, 1.0]}}, scheduler="asha")
    grid = np.linspace(0.02, 0.98, 24)
    records = [
        record(index, {"lr": lr}, **({"score": 1.0} if lr < 0.5 else bad)) for index, lr in enumerate(map(float, grid))
    ]
    proposed = [propose_point(spec, records, 24 + k, lambda point: None)["lr"] for k in range(20)]
    assert np.mean(np.array(proposed) < 0.5) > 0.8


@each_method
def test_of_trials_ended_early_those_that_got_a_rung_further_are_better_and_steps_within_a_rung_do_not_matter(
    method: str,
) -> None:
    spec = make_spec(method=method, startup=4, space={"lr": {"uniform": [0.001, 1.0]}}, scheduler="asha")

    def proposed(left: dict[str, Any], right: dict[str, Any]) -> np.float64:
        records = [
            record(index, {"lr": lr}, status="stopped", **(left if lr < 0.5 else right))
            for index, lr in enumerate(map(float, np.linspace(0.02, 0.98, 24)))
        ]
        return cast(
            "np.float64",
            np.mean([propose_point(spec, records, 24 + k, lambda point: None)["lr"] < 0.5 for k in range(20)]),
        )

    assert proposed({"score": 1.0, "steps": 31_000}, {"score": 9.0, "steps": 10_400}) > 0.8
    assert proposed({"score": 9.0, "steps": 10_000}, {"score": 1.0, "steps": 10_400}) > 0.8


@each_method
def test_a_point_of_several_seeds_counts_by_their_mean_once_all_have_ended(method: str) -> None:
    spec = make_spec(method=method, startup=4, space={"lr": {"uniform": [0.001, 1.0]}}, seeds_per_point=2)

    def proposed(other_seed: dict[str, Any]) -> np.float64:
        records = []
        for index, lr in enumerate(map(float, np.linspace(0.02, 0.98, 24))):
            # Where all that ended are equal, points are random.
            low = 1.0 + 0.01 * (index % 2)
            second: dict[str, Any] = {"score": low} if lr < 0.5 else other_seed
            records += [
                record(2 * index, {"lr": lr}, low if lr < 0.5 else 5.0, point_index=index),
                record(2 * index + 1, {"lr": lr}, point_index=index, **second),
            ]
        return cast(
            "np.float64",
            np.mean([propose_point(spec, records, 24 + k, lambda point: None)["lr"] < 0.5 for k in range(20)]),
        )

    most = 0.65 if method == "forest" else 0.8  # the forest draws a fifth
    assert proposed({"score": -9.0}) > most  # mean -2
    assert proposed({"score": 5.0}) < 1 - most
    assert proposed({"score": None, "status": "failed"}) > most
    # A model may look where nothing has ended, but not because of seeds that ended before their point.
    running = proposed({"score": 99.0, "status": "running"})
    assert running == proposed({"score": -99.0, "status": "running"})
    assert method != "tpe" or running > 0.8


@each_method
def test_every_kind_of_domain_keeps_its_bounds_steps_and_types(method: str) -> None:
    space = {
        "lr": {"qloguniform": [0.01, 0.5, 0.01]},
        "gamma": {"quniform": [0.9, 0.99, 0.03]},
        "clip_param": {"uniform": [0.1, 0.3]},
        "num_epochs": {"randint": [1, 5]},
        "train_batch_size": {"qrandint": [512, 1024, 128]},
        "minibatch_size": {"qlograndint": [64, 512, 64]},
        "num_envs": {"lograndint": [1, 9]},
        "hidden_sizes": {"grid": [[8], [16, 16]]},
        "vf_share_layers": {"choice": [True, False]},
    }
    spec = make_spec(method=method, num_samples=30, startup=4, space=space)
    points = search(spec, lambda point: -point["lr"] + point["num_epochs"])
    seen = {name: [point[name] for point in points] for name in space}
    assert set(map(json.dumps, seen["hidden_sizes"])) <= {"[8]", "[16, 16]"}
    assert set(seen["vf_share_layers"]) <= {True, False}
    assert set(seen["num_epochs"]) <= {1, 2, 3, 4}
    assert set(seen["num_envs"]) <= set(range(1, 9))
    assert set(seen["train_batch_size"]) <= {512, 640, 768, 896, 1024}
    assert set(seen["minibatch_size"]) <= set(range(64, 513, 64))
    assert set(seen["gamma"]) <= {0.9, 0.93, 0.96, 0.99}
    assert all(0.1 <= value <= 0.3 for value in seen["clip_param"])
    assert all(value == round(value, 2) and 0.01 <= value <= 0.5 for value in seen["lr"])
    for point in points:
        assert json.loads(json.dumps(point)) == point
        assert not any(isinstance(value, np.generic) for value in point.values())


@each_method
def test_a_proposal_whose_values_do_not_go_together_is_replaced(method: str) -> None:
    spec = make_spec(method=method, startup=4, space={"lr": {"uniform": [0.001, 1.0]}})
    records = [record(index, {"lr": lr}, lr) for index, lr in enumerate([0.1, 0.3, 0.5, 0.7, 0.9])]
    asked = []

    def check(point: dict[str, float]) -> None:
        asked.append(point)
        if point["lr"] > 0.5:
            raise SpecError("too large")

    assert all(propose_point(spec, records, 5 + k, check)["lr"] <= 0.5 for k in range(5))
    assert len(asked) > 5

    def refuse(point: dict[str, float]) -> None:
        raise SpecError("never")

    with pytest.raises(SpecError, match="never"):
        propose_point(spec, records, 5, refuse)


@each_method
def test_as_long_as_all_are_equally_good_points_are_random(method: str) -> None:
    """A model would know but where they are, and go to the corners of the space."""
    spec = make_spec(method=method, startup=4)

    def ended(count: int, score: float | None) -> list[TrialRecord]:
        return [record(index, draw_point(spec.space, index, spec.seed), score) for index in range(count)]

    def proposed(records: Sequence[TrialRecord]) -> dict[str, Any]:
        return propose_point(spec, records, len(records), lambda point: None)

    drawn = draw_point(spec.space, 20, spec.seed)
    assert proposed(ended(20, -200.0)) == drawn
    assert proposed(ended(20, None)) == drawn
    one_better = [*ended(19, -200.0), record(19, draw_point(spec.space, 19, spec.seed), -150.0)]
    assert proposed(one_better) != drawn
    # What runs tells nothing yet.
    running = record(19, draw_point(spec.space, 19, spec.seed), -150.0, status="running")
    assert proposed([*ended(19, -200.0), running]) == drawn


@each_method
def test_as_long_as_all_are_equally_good_no_point_is_tried_twice(method: str) -> None:
    space = {"activation": {"choice": ["tanh", "relu", "silu"]}}
    for seed in range(8):
        spec = make_spec(method=method, startup=1, num_samples=5, space=space, seed=seed)
        points = [point["activation"] for point in search(spec, lambda point: 1.0)]
        assert sorted(points[:3]) == ["relu", "silu", "tanh"]
        # There is no other.
        assert len(points) == 5


@each_method
def test_a_random_point_that_no_plan_has_looked_at_goes_together_too(method: str) -> None:
    """Four trials run at once: the first points that are asked for beyond the planned ones are random."""
    spec = make_spec(method=method, startup=4, space={"lr": {"uniform": [0.001, 1.0]}})
    records = [record(index, {"lr": 0.1}, 0.1) for index in range(3)]
    drawn = draw_point(spec.space, 4, spec.seed)

    def check(point: dict[str, float]) -> None:
        if point == drawn:
            raise SpecError("too large")

    other = propose_point(spec, records, 4, check)
    assert other != drawn
    assert propose_point(spec, records, 4, check) == other
    assert propose_point(spec, records, 4, lambda point: None) == drawn

    def refuse(point: dict[str, float]) -> None:
        raise SpecError("never")

    with pytest.raises(SpecError, match="never"):
        propose_point(spec, records, 4, refuse)


def test_without_optuna_the_plan_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    find_spec, real_import = importlib.util.find_spec, builtins.__import__
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "optuna" else find_spec(name, *rest)
    )

    def no_optuna(name: str, *rest: Any) -> Any:
        assert not name.startswith("optuna")
        return real_import(name, *rest)

    monkeypatch.setattr(builtins, "__import__", no_optuna)
    with pytest.raises(CannotRunError) as caught:
        make_plan(make_spec(), Machine(num_cpus=2))
    assert "tune-jobs[tpe]" in caught.value.hint
    make_plan(make_spec(search={"type": "random"}), Machine(num_cpus=2))
    make_plan(make_spec(search={"type": "auto"}), Machine(num_cpus=2))


def test_the_model_learns_from_the_score_that_the_selection_goes_by() -> None:
    spec, point = make_spec(), {"lr": 1e-3, "activation": "tanh"}
    one = record(0, point, 3.0).model_copy(update={"best_evaluation_return": 99.0})
    (known,) = known_points(spec, [one])
    assert known.score == present(score_trial(one)).score == 3.0


def test_where_trials_tell_a_score_by_the_objective_the_model_learns_from_that() -> None:
    spec, point = make_spec(), {"lr": 1e-3, "activation": "tanh"}
    ended = record(0, point, 3.0).model_copy(update={"best_evaluation_return": 99.0, "objective_score": 2.0})
    failed = record(1, point, 3.0, status="failed").model_copy(update={"objective_score": 2.0})
    without = record(2, point, 3.0, status="stopped").model_copy(update={"objective_score": -1.0, "checkpoints": ()})
    first, second, third = known_points(spec, [ended, failed, without])
    assert (first.scores, second.scores, third.scores) == ((2.0,), (None,), (-1.0,))


def test_where_others_tell_scores_one_that_tells_none_does_not_count_by_its_best_evaluation() -> None:
    """A return of 3 would be better than all env steps to a threshold, which are less than 0."""
    spec, point = make_spec(), {"lr": 1e-3, "activation": "tanh"}
    told = History(spec)
    # Never evaluated, and remembered before it is known what scores are.
    first = record(0, point, math.nan).model_copy(update={"objective_score": -2_000.0, "checkpoints": ()})
    told.known_points([first])
    second = record(1, point, 9.0).model_copy(update={"objective_score": -500.0})
    found = told.known_points([first, second])
    assert [item.scores for item in found] == [(-2_000.0,), (-500.0,)]
    assert [item.scores for item in told.known_points([first, second, record(2, point, 3.0)])][2] == (None,)


def test_a_sweep_of_a_former_version_goes_on_with_the_best_evaluations() -> None:
    """Its trials have no score by the objective; those that end from now on have one, which is another number."""
    spec, point = make_spec(), {"lr": 1e-3, "activation": "tanh"}
    told, former = History(spec), record(0, point, 3.0)
    assert [item.score for item in told.known_points([former])] == [3.0]
    newer = record(1, point, 4.0).model_copy(update={"objective_score": 1.0})
    assert [item.score for item in told.known_points([former, newer])] == [3.0, 4.0]
    assert [item.score for item in known_points(spec, [newer])] == [1.0]


def test_what_ends_without_a_threshold_that_anybody_knows_counts_by_its_best_evaluation() -> None:
    spec, point = make_spec(objective={"type": "steps_to_threshold"}), {"lr": 1e-3, "activation": "tanh"}
    told = History(spec)
    assert told.known_points([]) == []
    assert [item.score for item in told.known_points([record(0, point, 3.0)])] == [3.0]


def test_of_what_has_not_begun_a_model_is_told_nothing() -> None:
    spec, point = make_spec(seeds_per_point=2), {"lr": 1e-3, "activation": "tanh"}
    waiting = [record(index, point, status="pending", point_index=0) for index in range(2)]
    assert known_points(spec, waiting) == []
    (known,) = known_points(spec, [record(0, point, 3.0, point_index=0), waiting[1]])
    assert (known.is_running, known.scores) == (True, (3.0,))


def test_further_seeds_that_wait_do_not_hide_a_point_from_the_model() -> None:
    """An interrupted race of the best points: they would be missing, and their scores are known."""
    spec, point = make_spec(), {"lr": 1e-3, "activation": "tanh"}
    further = record(1, point, status="pending", point_index=0).model_copy(update={"seed_index": 1})
    (known,) = known_points(spec, [record(0, point, 3.0, point_index=0), further])
    assert (known.is_running, known.scores) == (False, (3.0,))


@each_method
def test_failures_alone_tell_no_more_of_where_something_is_to_be_found(method: str) -> None:
    """One failed trial among equally bad ones, and a model went to the corners that are farthest from it."""
    spec = make_spec(method=method, startup=4)
    scores = [None if index == 3 else -200.0 for index in range(20)]
    records = [
        record(index, draw_point(spec.space, index, spec.seed), score, status="completed" if score else "failed")
        for index, score in enumerate(scores)
    ]

    def propose(known: Sequence[TrialRecord]) -> dict[str, Any]:
        return propose_point(spec, known, len(known), lambda point: None)

    assert propose(records) == draw_point(spec.space, 20, spec.seed)
    better = record(20, draw_point(spec.space, 20, spec.seed), -150.0)
    assert propose([*records, better]) != draw_point(spec.space, 21, spec.seed)

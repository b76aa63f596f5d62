"""What choosing a point costs: nothing is looked at twice, and one thread computes."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.optimize  # noqa: F401 - brings a BLAS of its own, which gp loads when it first computes
from threadpoolctl import threadpool_info, threadpool_limits

from analysis.records import PriorPointRecord, PriorRecord, TrialRecord
from tune_jobs.search import bandit, gp, history
from tune_jobs.search.bandit import Gain, Next
from tune_jobs.search.history import History, KnownPoint, known_points
from tune_jobs.search.prior import with_prior
from tune_jobs.search.proposal import next_point
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec

SPEC = {
    "env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"loguniform": [1e-5, 1e-1]}}, "num_samples": 20,
    "seeds_per_point": 2,
}  # fmt: skip


@pytest.fixture
def spec() -> SweepSpec:
    return load_spec(SPEC)


def record(index: int, score: float | None) -> TrialRecord:
    """Of two seeds for each point; without a score it runs."""
    name = f"t{index:04d}"
    kept = {"trial_id": name, "iteration": 1, "num_env_steps": 1000, "evaluation_return": score}
    return TrialRecord(
        trial_id=name, index=index, point_index=index // 2, seed_index=index % 2, seed=index, hyperparams={},
        point={"lr": 1e-3 * (1 + index // 2)}, num_env_steps=1000, status="running" if score is None else "completed",
        checkpoints=[] if score is None else [kept],
    )  # fmt: skip


@pytest.fixture
def looked_at(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The points of which it is asked what they tell."""
    seen: list[int] = []
    known = history._known

    def noting(spec: SweepSpec, members: Any, score: Any) -> KnownPoint | None:
        seen.append(members[0].point_index)
        return known(spec, members, score)

    monkeypatch.setattr(history, "_known", noting)
    return seen


def test_what_has_not_changed_is_not_looked_at_again(spec: SweepSpec, looked_at: list[int]) -> None:
    told, records = History(spec), [record(index, float(index)) for index in range(10)]
    first = told.known_points(records)
    assert sorted(looked_at) == [0, 1, 2, 3, 4]
    looked_at.clear()
    assert told.known_points(list(records)) == first
    assert looked_at == []


def test_a_history_tells_what_the_records_tell_whatever_has_changed(spec: SweepSpec, looked_at: list[int]) -> None:
    told, records = History(spec), [record(index, None) for index in range(4)]
    told.known_points(records)
    steps: list[Callable[[], None]] = [
        lambda: records.append(record(4, None)),
        lambda: records.append(record(5, None)),
        lambda: records.__setitem__(1, record(1, 3.0)),
        lambda: records.__setitem__(0, record(0, 5.0)),
        lambda: records.__setitem__(5, record(5, -1.0)),
        lambda: records.__setitem__(4, record(4, 2.0).model_copy(update={"status": "failed"})),
        lambda: records.__delitem__(3),
    ]
    changed = [2, 2, 0, 0, 2, 2, 1]
    for step, point in zip(steps, changed, strict=True):
        step()
        looked_at.clear()
        found = told.known_points(records)
        assert looked_at == [point]
        assert found == known_points(spec, records)
    assert [(item.is_running, item.scores) for item in found] == [
        (False, (5.0, 3.0)),
        (True, ()),
        (False, (None, -1.0)),
    ]


def num_threads() -> set[int]:
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@pytest.fixture
def two_threads() -> Any:
    """BLAS as it would be on two cores."""
    with threadpool_limits(2, user_api="blas"):
        if num_threads() != {2}:
            pytest.skip(f"NumPy's BLAS has {num_threads() or 'no known number of'} threads, whatever it is told")
        yield


def test_a_method_computes_with_one_thread(two_threads: None, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    propose = gp.propose

    def noting(*asked: Any) -> dict[str, Any]:
        seen.append(num_threads())
        return propose(*asked)

    monkeypatch.setattr(gp, "propose", noting)
    known = [KnownPoint({"lr": lr}, scores=(lr,)) for lr in (1e-4, 1e-3, 1e-2)]
    for when in ({}, {"when": {"activation": "tanh"}}):
        space = load_spec(
            {**SPEC, "space": {"lr": {"loguniform": [1e-5, 1e-1], **when}, "activation": {"choice": ["tanh", "relu"]}}}
        ).space
        told = [KnownPoint({**item.point, "activation": "tanh"}, scores=item.scores) for item in known]
        next_point("gp", space, told, 3, seed=0, num_startup_trials=3)
    assert seen == [{1}, {1}]
    assert num_threads() == {2}


def test_pb2_computes_with_one_thread(two_threads: None, monkeypatch: pytest.MonkeyPatch, spec: SweepSpec) -> None:
    seen = []
    fitted = bandit._Model.fitted

    def noting(*asked: Any) -> Any:
        seen.append(num_threads())
        return fitted(*asked)

    monkeypatch.setattr(bandit._Model, "fitted", noting)
    gains = [Gain(time=step, before=0.0, point={"lr": 10.0**-step}, gain=1.0) for step in range(2, 5)]
    bandit.propose(Next(5.0, 0.0, {"lr": 1e-3}, ()), spec.space, gains, np.random.default_rng(0), 0.25)
    assert seen == [{1}]
    assert num_threads() == {2}


def test_own_scores_are_not_looked_at_anew_for_each_point_of_an_earlier_sweep() -> None:
    looks = 0

    class Counted(KnownPoint):
        @property
        def score(self) -> float | None:
            nonlocal looks
            looks += 1
            return self.scores[0]

    own = [Counted({"lr": 1e-3}, (None if at % 5 == 0 else float(at),)) for at in range(50)]
    points = tuple(PriorPointRecord(point={"lr": 1e-3}, share=at / 400) for at in range(400))
    told = with_prior(own, [PriorRecord(sweep="first", env_id="Acrobot-v1", points=points)])
    assert len(told) == 450
    # Between two own ones each point is told of both, a few times.
    assert looks < 10 * len(own) + 8 * len(points)

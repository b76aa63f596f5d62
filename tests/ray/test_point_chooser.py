"""Who chooses points where a method does: what the method is told, and what becomes of the other seeds of a point."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest

from analysis.records import ChosenPointRecord, PriorRecord, SweepRecord, TrialRecord
from tune_jobs.ray_tune import searcher
from tune_jobs.ray_tune.searcher import PointChooser
from tune_jobs.search.history import History
from tune_jobs.spec.file import load_spec

pytestmark = pytest.mark.ray

SPEC = load_spec(
    {
        "env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"loguniform": [1e-4, 1e-2]}}, "num_samples": 4,
        "seeds_per_point": 2, "search": {"type": "gp", "num_startup_trials": 1},
    }
)  # fmt: skip


class Sweep:
    """Records of trials, and what was asked of the method: the trials it was told of, the index and the prior."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, chosen_points: Sequence[ChosenPointRecord] = ()) -> None:
        self.records = {
            f"t{index:04d}": TrialRecord(
                trial_id=f"t{index:04d}", index=index, point_index=index // 2, seed_index=index % 2, seed=index,
                point={}, has_point=False,
            )
            for index in range(8)
        }  # fmt: skip
        self.histories: list[History] = []
        self.asked: list[tuple[dict[str, str], int, Any]] = []
        prior = PriorRecord(sweep="before", env_id="CartPole-v1", points=())
        record = SweepRecord(
            name="mine", spec=SPEC.model_dump(mode="json"), state="running", num_trials=8, created_at=0.0,
            evaluation_seeds=(1,), confirmation_seeds=(2,), prior=(prior,), chosen_points=tuple(chosen_points),
        )  # fmt: skip

        def propose(
            spec: Any, records: Sequence[TrialRecord], drawn_index: int, check: Callable[[Any], Any], prior: Any,
            *, history: History,
        ) -> dict[str, Any]:  # fmt: skip
            self.histories.append(history)
            self.asked.append(({item.trial_id: item.status for item in records}, drawn_index, prior))
            point = {"lr": 1e-3 * (1 + len(self.asked))}
            check(point)
            return point

        monkeypatch.setattr(searcher, "propose_point", propose)
        self.chooser = PointChooser(SPEC, record, lambda: list(self.records.values()), self.change)
        self.prior = record.prior

    def change(self, trial_id: str, become: Callable[[TrialRecord], TrialRecord]) -> None:
        self.records[trial_id] = become(self.records[trial_id])

    def point(self, index: int) -> Any:
        record = self.records[f"t{index:04d}"]
        return record.point["lr"] if record.has_point else None


def test_a_trial_that_was_given_to_a_process_counts_as_running_before_it_has_told_anything(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sweep = Sweep(monkeypatch)
    for name in ("t0000", "t0002", "t0004"):
        sweep.chooser.prepare(name)
    told, drawn, prior = sweep.asked[-1]
    assert (drawn, prior) == (2, sweep.prior)
    assert [told[f"t{index:04d}"] for index in range(6)] == ["running", "pending"] * 3
    # They are so for the method alone: the records change when a process tells of itself.
    assert {record.status for record in sweep.records.values()} == {"pending"}


def test_all_seeds_of_a_point_get_its_values_at_once_and_it_is_chosen_once(monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = Sweep(monkeypatch)
    for name in ("t0003", "t0002"):
        sweep.chooser.prepare(name)
        assert len(sweep.asked) == 1
        assert [sweep.point(index) for index in range(4)] == [None, None, 2e-3, 2e-3]
    assert sweep.records["t0002"].hyperparams["lr"] == sweep.records["t0003"].hyperparams["lr"] == 2e-3


def test_a_driver_killed_between_two_seeds_of_a_point_leaves_it_one_point(monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = Sweep(monkeypatch)
    sweep.chooser.prepare("t0000")
    lost = sweep.records["t0001"].model_copy(update={"has_point": False, "point": {}, "hyperparams": {}})
    sweep.records["t0001"] = lost
    sweep.chooser.prepare("t0001")
    assert len(sweep.asked) == 1
    assert sweep.point(1) == sweep.point(0)
    assert sweep.records["t0001"].hyperparams == sweep.records["t0000"].hyperparams


def test_what_the_records_told_is_remembered_from_choice_to_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = Sweep(monkeypatch)
    for name in ("t0000", "t0002", "t0004"):
        sweep.chooser.prepare(name)
    assert len(sweep.histories) == 3
    assert len(set(map(id, sweep.histories))) == 1


def test_points_that_somebody_chose_take_no_random_numbers_of_others(monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = Sweep(monkeypatch, [ChosenPointRecord(num_points=1, point={"lr": 5e-3})])
    for name in ("t0000", "t0004", "t0006"):
        sweep.chooser.prepare(name)
    assert [drawn for _, drawn, _ in sweep.asked] == [0, 1, 2]

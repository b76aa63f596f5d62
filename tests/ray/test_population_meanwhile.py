"""What pb2's model is asked of when several trials are given new values at the same comparison."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from analysis.records import TrialRecord
from tune_jobs.ray_tune import population
from tune_jobs.ray_tune.population import Population
from tune_jobs.ray_tune.scheduling import CopyFrom, Decision, NobodyWaits, Standing
from tune_jobs.search.bandit import Next
from tune_jobs.search.gains import Score
from tune_jobs.spec.file import load_spec

pytestmark = pytest.mark.ray


def test_values_that_another_was_given_at_the_same_comparison_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = load_spec(
        {
            "env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"loguniform": [1e-4, 1e-2]}}, "num_samples": 8,
            "scheduler": {"type": "pb2", "perturb_every_env_steps": 1_000, "quantile_fraction": 0.25},
        }
    )  # fmt: skip
    names = [f"t{index:04d}" for index in range(8)]
    points = {name: {"lr": 1e-3 + index * 1e-4} for index, name in enumerate(names)}
    records = {
        name: TrialRecord(trial_id=name, index=index, point_index=index, seed=index, point=points[name])
        for index, name in enumerate(names)
    }
    asked: list[Next] = []

    def propose(coming: Next, *_: Any) -> dict[str, Any]:
        asked.append(coming)
        return {"lr": 5e-3 + len(asked) * 1e-4}

    monkeypatch.setattr(population, "propose", propose)
    judge = Population(spec, records.__getitem__, lambda _: {})
    for name in names:
        judge.begins(name)
    standings = [Standing(name, 2_000, float(index), evaluated=True) for index, name in enumerate(names)]
    decided = judge.compared(standings, NobodyWaits())
    assert [name for name, outcome in decided.items() if isinstance(outcome, CopyFrom)] == names[:2]
    assert [decided[name] for name in names[2:]] == [Decision.SAVE] * 6
    # The interval that is to come ends at 3,000 env steps, and begins at the score of the trial that is copied.
    assert [coming.time for coming in asked] == [3.0, 3.0]
    assert all(coming.before in (6.0, 7.0) for coming in asked)
    others = [points[name] for name in names[2:]]
    assert asked[0].meanwhile == [points["t0001"], *others]
    assert asked[1].meanwhile == [{"lr": 5e-3 + 1e-4}, *others]
    # At the next comparison the records have them.
    asked.clear()
    judge.compared([Standing(names[2], 4_000, -1.0, evaluated=True)], NobodyWaits())
    assert [coming.meanwhile[0] for coming in asked] == [points["t0000"]]


def test_what_intervals_have_gained_is_read_once_for_all_copies_of_a_comparison_and_anew_at_the_next() -> None:
    scheduler = {"type": "pb2", "perturb_every_env_steps": 1_000, "quantile_fraction": 0.5}
    spec = load_spec(
        {
            "env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"loguniform": [1e-4, 1e-2]}}, "num_samples": 8,
            "scheduler": scheduler,
        }
    )  # fmt: skip
    records = {
        f"t{index:04d}": TrialRecord(
            trial_id=f"t{index:04d}", index=index, point_index=index, seed=index, point={"lr": 1e-3 + index * 1e-4}
        )
        for index in range(8)
    }
    scores = {name: [Score(1, 500, 0.0), Score(2, 1_000, float(name[1:]))] for name in records}
    asked: list[Sequence[str]] = []

    def curves(trial_ids: Sequence[str]) -> dict[str, list[Score]]:
        asked.append(trial_ids)
        return scores

    def compared(num_env_steps: int) -> dict[str, Decision | CopyFrom]:
        standings = [Standing(name, num_env_steps, float(name[1:]), evaluated=True) for name in records]
        return judge.compared(standings, NobodyWaits())

    judge = Population(spec, records.__getitem__, curves)
    for name in records:
        judge.begins(name)
    for num_comparisons in (1, 2):
        decided = compared(1_000 * num_comparisons)
        assert [name for name in records if isinstance(decided[name], CopyFrom)] == list(records)[:4]
        assert asked == [list(records)] * num_comparisons


@pytest.mark.parametrize("type_", ["pbt", "pb2"])
@pytest.mark.parametrize("num_wrong", [0, 3, 1_000])
def test_values_that_do_not_go_together_are_drawn_again_and_where_none_do_those_of_the_better_one_stay(
    monkeypatch: pytest.MonkeyPatch, type_: str, num_wrong: int
) -> None:
    spec = load_spec(
        {
            "env": "CartPole-v1", "algorithm": "ppo", "space": {"minibatch_size": {"randint": [64, 5_001]}},
            "hyperparams": {"train_batch_size": 2048}, "num_samples": 2,
            "scheduler": {"type": type_, "perturb_every_env_steps": 1_000, "quantile_fraction": 0.5},
        }
    )  # fmt: skip
    records = {
        f"t000{index}": TrialRecord(
            trial_id=f"t000{index}", index=index, point_index=index, seed=index, point={"minibatch_size": 64 << index}
        )
        for index in range(2)
    }
    num_drawn = 0

    def draw(*_: Any) -> dict[str, Any]:
        nonlocal num_drawn
        num_drawn += 1
        # No minibatch is larger than the batch.
        return {"minibatch_size": 4096 if num_drawn <= num_wrong else 64}

    monkeypatch.setattr(population, "mutate", draw)
    monkeypatch.setattr(population, "propose", draw)
    judge = Population(spec, records.__getitem__, (lambda _: {}) if type_ == "pb2" else None)
    for name in records:
        judge.begins(name)
    standings = [Standing(name, 1_000, float(index), evaluated=True) for index, name in enumerate(records)]
    decided = judge.compared(standings, NobodyWaits())["t0000"]
    assert isinstance(decided, CopyFrom)
    assert decided == CopyFrom("t0001", {"minibatch_size": 128 if num_wrong == 1_000 else 64})

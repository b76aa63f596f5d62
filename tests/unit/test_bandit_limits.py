"""Where the model of a population's intervals is at its limits: few intervals, many, a collapse, the ends of ranges."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from analysis.records import ChangeRecord, IterationRecord, TrialRecord
from tune_jobs.search.bandit import MOST_INTERVALS, Gain, Next, _unit, _value, propose
from tune_jobs.search.gains import Evaluations, Score, gains_of
from tune_jobs.search.mutation import mutate
from tune_jobs.spec.domains import Domain
from tune_jobs.store.sweep_store import SweepStore

DOMAIN: TypeAdapter[Any] = TypeAdapter(Domain)
SPACE = {"x": DOMAIN.validate_python({"uniform": [0.0, 1.0]})}


def proposed(coming: Next, gains: list[Gain], seed: int = 0) -> dict[str, Any]:
    return propose(coming, SPACE, gains, np.random.default_rng(seed), 0.25)


@pytest.mark.parametrize(("num", "least"), [(2, 0.5), (3, 0.7)])
def test_two_known_intervals_are_enough_for_the_model(num: int, least: float) -> None:
    # The greater the value, the more was gained; a mutation is drawn anew, or 0.8 or 1.2 times 0.5.
    gains = [Gain(1.0 + at, 0.0, float(at), {"x": 0.2 + 0.3 * at}) for at in range(num)]
    coming = Next(num + 1.0, 0.0, {"x": 0.5}, [])
    for seed in range(6):
        found = proposed(coming, gains, seed)["x"]
        assert found != mutate(coming.point, SPACE, np.random.default_rng(seed), 0.25)["x"]
        assert found > least


def test_the_newest_intervals_alone_are_modelled_in_whatever_order_they_come() -> None:
    # Early on little was best, lately much is.
    num = 2 * MOST_INTERVALS
    places = np.random.default_rng(3).random(num)
    best = [0.1 if at < MOST_INTERVALS else 0.9 for at in range(num)]
    gains = [Gain(float(at), 0.0, 1.0 - abs(x - best[at]), {"x": float(x)}) for at, x in enumerate(places)]
    coming = Next(float(num), 0.0, {"x": 0.5}, [{"x": 0.4}])
    expected = proposed(coming, gains[-MOST_INTERVALS:])
    assert expected["x"] > 0.7
    assert proposed(coming, gains) == proposed(coming, gains[::-1]) == expected


def test_a_trial_that_is_added_to_a_population_goes_by_the_intervals_of_its_own_time() -> None:
    """Those of the trials that were there before go on to much later, when other values were best."""
    rng = np.random.default_rng(3)
    times = np.repeat(np.arange(1.0, 41.0), 16)
    values = rng.random(len(times))
    bests = np.where(times < 20, 0.1, 0.9)
    gains = [
        Gain(time, 0.0, 1.0 - abs(x - best), {"x": float(x)})
        for time, x, best in zip(times, values, bests, strict=True)
    ]
    found = [proposed(Next(time, 0.0, {"x": 0.5}, []), gains)["x"] for time in (3.0, 38.0)]
    assert found[0] < 0.3
    assert found[1] > 0.7
    near = [gain for gain in gains if gain.time <= 6]
    assert len(near) == MOST_INTERVALS
    assert proposed(Next(3.5, 0.0, {"x": 0.5}, []), gains) == proposed(Next(3.5, 0.0, {"x": 0.5}, []), near)


def test_a_list_that_acts_as_a_range_has_changed_gets_a_drawn_value() -> None:
    kind = DOMAIN.validate_python({"choice": ["a", "b", "c"], "when": {"n": [2, 3, 4]}})
    space = {"n": DOMAIN.validate_python({"randint": [1, 5]}), "kind": kind}
    found = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        gains = [Gain(float(at), 0.0, rng.normal(), {"n": 1}) for at in range(6)]
        point = propose(Next(7.0, 0.0, {"n": 1}, []), space, gains, rng, 0.25)
        assert ("kind" in point) is (point["n"] > 1)
        found += [point["kind"]] if "kind" in point else []
    assert len(found) > 30
    assert all(found.count(value) > 5 for value in "abc"), found


@pytest.mark.parametrize(
    "given",
    [
        {"loguniform": [1e-5, 1e-1]}, {"loguniform": [3e-6, 7e-3]}, {"uniform": [0.1, 0.7]}, {"uniform": [-0.3, 1.1]},
        {"qloguniform": [0.01, 0.5, 0.01]}, {"lograndint": [3, 1000]}, {"one_minus_loguniform": [0.9, 0.9999]},
        {"power_of_two": [8, 512]},
    ],
)  # fmt: skip
def test_the_ends_of_a_range_are_in_it_whatever_rounding_makes_of_their_logarithms(given: dict[str, Any]) -> None:
    domain = DOMAIN.validate_python(given)
    for unit in (0.0, 1.0):
        value = _value(domain, unit)
        assert domain.gives(value), (given, value)
        assert _unit(domain, value) == pytest.approx(unit, abs=1e-3)


class Counted(tuple[Any, ...]):
    """A tuple that counts how often its items are gone through from either end."""

    __slots__ = ()
    num_passes = 0

    def __iter__(self) -> Iterator[Any]:
        Counted.num_passes += 1
        return super().__iter__()

    def __reversed__(self) -> Iterator[Any]:
        Counted.num_passes += 1
        return iter(self[::-1])


def test_changes_and_scores_are_not_gone_through_for_each_interval_and_need_not_be_in_order() -> None:
    rng = np.random.default_rng(0)
    curve = Counted(Score(at, 100 * at, float(rng.integers(9))) for at in range(1, 401))
    ends = rng.integers(0, 400, size=100).tolist()
    changes = Counted(
        ChangeRecord(
            iteration=at, num_env_steps=100 * at, source_trial_id="t0001", source_iteration=at // 2,
            before={"number": number}, after={}, time=0.0,
        )
        for number, at in enumerate(ends)
    )  # fmt: skip
    trial = TrialRecord(trial_id="t0000", index=0, point_index=0, seed=0, point={"number": -1})
    trial = trial.model_copy(update={"changes": changes})
    Counted.num_passes = 0
    found = gains_of([trial], {"t0000": curve, "t0001": curve}, 100)
    assert Counted.num_passes < 10
    # The first change that is not before an interval's end says what it was trained with.
    assert len(found) == 399
    assert [one.point["number"] for one in found] == [
        next((number for number, at in enumerate(ends) if at >= one.time), -1) for one in found
    ]
    copied = [(at, one.before) for at, one in enumerate(found, start=1) if at in ends and at > 1]
    assert copied == [(at, curve[at // 2 - 1].value) for at, _ in copied]


def test_evaluations_that_were_read_stay_known_while_the_results_can_not_be_read(tmp_path: Path) -> None:
    store = SweepStore(tmp_path / "mine")
    store.create()
    trial = store.trial("t0000")
    known = IterationRecord(iteration=2, num_env_steps=200, num_episodes=2, time_s=1.0, evaluation_return=2.0)
    trial.append_iterations([known])
    evaluations = Evaluations(store)
    before = evaluations(["t0000"])
    assert [one.value for one in before["t0000"]] == [2.0]
    results = trial.results_path
    kept = results.read_bytes()
    results.unlink()
    results.mkdir()  # as bad as a disk that can't be read
    assert evaluations(["t0000"]) == before
    results.rmdir()
    results.write_bytes(kept)
    assert evaluations(["t0000"]) == before


@pytest.mark.parametrize("collapse", [-3_000.0, -1e5, -1e30])
def test_one_collapse_does_not_hide_what_the_others_gained(collapse: float) -> None:
    """It was the deviation by which all gains are judged: the others were as good as equal, and the choice blind."""
    off = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        values = rng.random(48)
        gained = 20 * (1 - 2 * np.abs(values - 0.8)) + rng.normal(size=48)
        gained[20] = collapse
        gains = [Gain(float(at // 8), 100.0, float(gained[at]), {"x": float(x)}) for at, x in enumerate(values)]
        off.append(abs(proposed(Next(7.0, 100.0, {"x": 0.3}, []), gains, seed)["x"] - 0.8))
    # Uniform draws are off by 0.34.
    assert np.mean(off) < 0.17

"""When a model is asked for points: with a scheduler, by how much of their training the points have had."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import pytest
from test_search_methods import SPACE, make_spec, record, valley

from analysis.records import PriorPointRecord, PriorRecord, TrialRecord
from tune_jobs.cli.plan_view import search_fact
from tune_jobs.search.history import KnownPoint, known_points
from tune_jobs.search.prior import prior_record, with_prior
from tune_jobs.search.proposal import next_point, propose_point
from tune_jobs.search.startup import is_enough, most_needed
from tune_jobs.spec.draws import draw_point
from tune_jobs.spec.sweep_spec import SweepSpec

WHOLE = 200_000
ASHA: dict[str, Any] = {"scheduler": "asha", "stop": {"num_env_steps": WHOLE}}


def trials(spec: SweepSpec, *steps: int, first: int = 0) -> list[TrialRecord]:
    """One trial of each length; what is shorter than a whole training was ended by the scheduler."""
    points = [draw_point(spec.space, first + index, spec.seed) for index in range(len(steps))]
    return [
        record(first + index, point, valley(point), status="completed" if taken >= WHOLE else "stopped", steps=taken)
        for index, (point, taken) in enumerate(zip(points, steps, strict=True))
    ]


def is_drawn(spec: SweepSpec, records: list[TrialRecord]) -> bool:
    index = len(records)
    return propose_point(spec, records, index, lambda _: None) == draw_point(spec.space, index, spec.seed)


def test_what_was_ended_at_rungs_counts_for_what_it_trained() -> None:
    spec = make_spec(num_samples=300, startup=4, method="gp", **ASHA)
    # Twenty of a twentieth each are one whole training.
    rungs = [WHOLE // 20] * 20
    assert is_drawn(spec, trials(spec, *rungs))
    assert is_drawn(spec, trials(spec, *rungs, WHOLE, WHOLE))
    assert not is_drawn(spec, trials(spec, *rungs, WHOLE, WHOLE, WHOLE))
    assert is_drawn(spec, trials(spec, *rungs, *[WHOLE // 2] * 5))
    assert not is_drawn(spec, trials(spec, *rungs, *[WHOLE // 2] * 6))
    # Without a scheduler four points are enough, as they were.
    assert not is_drawn(make_spec(num_samples=300, startup=4, method="gp"), trials(spec, *[WHOLE] * 4))


@pytest.mark.parametrize(("num_samples", "given", "needed"), [(30, 0, 10), (33, 0, 11), (31, 5, 11), (6, 0, 4)])
def test_of_a_small_sweep_a_third_has_to_end(num_samples: int, given: int, needed: int) -> None:
    points = [{"lr": 1e-3 * (1 + index), "activation": "tanh"} for index in range(given)]
    spec = make_spec(num_samples=num_samples, startup=4, method="gp", points=points, **ASHA)
    rungs = [WHOLE // 20] * needed
    assert is_drawn(spec, trials(spec, *rungs[1:]))
    assert not is_drawn(spec, trials(spec, *rungs))


def test_running_points_count_for_nothing_and_few_whole_ones_are_not_enough() -> None:
    ended = [KnownPoint({}, (1.0,))] * 3
    assert not is_enough([*ended, KnownPoint({}, is_running=True)], 4, 5)
    assert is_enough([*ended, KnownPoint({}, (None,))], 4, None)
    assert not is_enough([KnownPoint({}, (1.0,), trained=0.1)] * 39, 4, None)
    # The sum of ten tenths is not quite one.
    assert is_enough([KnownPoint({}, (1.0,), trained=0.1)] * 10, 1, None)
    assert [most_needed(10, number, 0) for number in (30, 31, 200)] == [10, 11, 67]


def test_of_many_that_run_at_once_the_model_proposes_some() -> None:
    """96 points, of which 64 run at once, all of which end at the first rung."""
    spec = make_spec(num_samples=96, startup=10, method="gp", **ASHA)
    running = [record(index, draw_point(spec.space, index, spec.seed), status="running") for index in range(96)]
    asked = [
        is_enough(known_points(spec, [*trials(spec, *[WHOLE // 20] * ended), *running[ended : ended + 63]]), 10, 96)
        for ended in range(33)
    ]
    # With 63 beside it, a third of the 33 others have ended.
    assert asked == [False] * 11 + [True] * 22
    assert most_needed(10, 96, 63) == 11


def test_without_a_sweep_the_same_counts() -> None:
    spec = make_spec(method="gp")
    points = [draw_point(spec.space, index, 0) for index in range(12)]
    ended = [KnownPoint(point, (valley(point),), level=0, trained=0.05) for point in points]
    drawn = draw_point(spec.space, 12, 0)
    assert next_point("gp", spec.space, ended, 12, seed=0) == drawn
    assert next_point("gp", spec.space, ended, 12, seed=0, num_points=36) != drawn
    whole = [dataclasses.replace(point, trained=1.0) for point in ended]
    assert next_point("gp", spec.space, whole, 12, seed=0) != drawn


def shares(spec: SweepSpec, *records: TrialRecord) -> list[float]:
    return [point.trained for point in known_points(spec, records)]


def test_the_share_is_that_of_the_trial_s_own_length_and_the_mean_over_its_seeds() -> None:
    spec = make_spec(seeds_per_point=2, method="gp", **ASHA)
    point = {"lr": 1e-3, "activation": "tanh"}

    def seed(index: int, steps: int, status: str = "stopped", **values: Any) -> TrialRecord:
        made = record(index, {**point, **values}, 1.0, status=status, steps=steps, point_index=0)
        return made.model_copy(update={"seed_index": index})

    assert shares(spec, seed(0, 10_000), seed(1, 30_000)) == [pytest.approx(0.1)]
    assert shares(spec, seed(0, 10_000), seed(1, 30_000, "running")) == [pytest.approx(0.05)]
    # What came to an end of its own has told all that it will; ten that failed at once are no ten trainings.
    assert shares(spec, seed(0, 50_000, "completed"), seed(1, 50_000, "completed")) == [1.0]
    assert shares(spec, seed(0, 10_000, "failed"), seed(1, 0, "failed")) == [pytest.approx(0.025)]
    alone = make_spec(seeds_per_point=2, method="gp")
    assert shares(alone, seed(0, 10_000, "failed"), seed(1, 0, "failed")) == [1.0]
    assert shares(spec, seed(0, 10_000, "running"), seed(1, 0, "pending")) == [1.0]
    # A last iteration may be longer than what was left.
    assert shares(spec, seed(0, 200_500), seed(1, 200_500)) == [1.0]
    lengths = make_spec(
        method="gp", space={**SPACE, "stop.num_env_steps": {"choice": [40_000, 200_000]}}, scheduler="asha"
    )
    short: dict[str, Any] = {"stop.num_env_steps": 40_000}
    found = shares(lengths, seed(0, 10_000, **short))
    assert found == [pytest.approx(0.25)]


def test_points_of_an_earlier_sweep_count_for_what_they_were_trained_there() -> None:
    former = PriorPointRecord(point={"lr": 1e-3}, share=0.5)
    points = (former, former.model_copy(update={"trained": 0.2}), PriorPointRecord(point={}, share=None, trained=0.1))
    prior = PriorRecord(sweep="earlier", env_id="CartPole-v1", points=points)
    own = [KnownPoint({"lr": 1e-2}, (float(score),), level=0, trained=0.05) for score in range(5)]
    assert [point.trained for point in with_prior(own, [prior])] == [1.0, 0.2, 0.1] + [0.05] * 5
    enough = [KnownPoint({"lr": 1e-2}, (float(score),)) for score in range(12)]
    found = with_prior([*own, *enough], [prior])
    assert [point.trained for point in found] == [1.0, 0.2, 0.1] + [0.05] * 5 + [1.0] * 12
    spec = make_spec(num_samples=300, method="gp", **ASHA)
    earlier = prior_record(spec, "earlier", spec, trials(spec, *[WHOLE // 20] * 12, WHOLE))
    assert [point.trained for point in earlier.points] == [pytest.approx(0.05)] * 12 + [1.0]


FEWER = "or fewer that were trained for as long as 10 whole ones"


def fact(at_once: int, **changes: Any) -> str:
    return search_fact(make_spec(startup=10, method="gp", **changes), at_once)


@pytest.mark.parametrize(
    ("changes", "at_once", "told"),
    [
        ({"num_samples": 200}, 1, "10 have ended"),
        ({"num_samples": 30, **ASHA}, 1, "10 have ended"),
        ({"num_samples": 200, **ASHA}, 1, f"67 have ended, {FEWER}"),
        ({"num_samples": 200, **ASHA}, 21, f"60 have ended, {FEWER}"),
        # Of two seeds each, 11 points run at once.
        ({"num_samples": 200, "seeds_per_point": 2, **ASHA}, 21, f"64 have ended, {FEWER}"),
        ({"num_samples": 31, "scheduler": "median"}, 1, f"11 have ended, {FEWER}"),
        ({"num_samples": 200, "prior": ["earlier"], **ASHA}, 1, f"67 have ended, those of prior among them, {FEWER}"),
    ],
)
def test_the_plan_says_when_the_model_begins(changes: Mapping[str, Any], at_once: int, told: str) -> None:
    assert fact(at_once, **changes) == f"gp: its model proposes points once {told}"

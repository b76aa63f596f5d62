"""Values for a population's next interval by what intervals have gained, and how these are read from records."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drifting_population import SPACE, final_score
from pydantic import TypeAdapter

from analysis.records import ChangeRecord, IterationRecord, TrialRecord
from tune_jobs.search.bandit import Gain, Next, propose
from tune_jobs.search.gains import Evaluations, Score, gains_of
from tune_jobs.search.mutation import mutate
from tune_jobs.spec.domains import Domain
from tune_jobs.store.sweep_store import SweepStore

DOMAIN: TypeAdapter[Any] = TypeAdapter(Domain)


def mutated(coming: Next, gains: Sequence[Gain], rng: np.random.Generator) -> dict[str, Any]:
    return mutate(coming.point, SPACE, rng, 0.25)


def proposed(coming: Next, gains: Sequence[Gain], rng: np.random.Generator) -> dict[str, Any]:
    return propose(coming, SPACE, gains, rng, 0.25)


def test_it_does_better_than_mutations_where_the_best_values_drift() -> None:
    """Best scores of populations of four after 16 intervals, over 24 seeds."""
    seeds = range(24)
    theirs = np.array([final_score(mutated, seed, 4, 16) for seed in seeds])
    ours = np.array([final_score(proposed, seed, 4, 16) for seed in seeds])
    assert (ours > theirs).mean() >= 0.7
    assert ours.mean() > theirs.mean() + 1.0


def gains_at(domain: Any, best: float, *, num: int = 40, time: int = 1) -> list[Gain]:
    """Gains that fall with the distance from the best place of a range, from 0 to 1, in its scale."""
    low, high = domain.codes
    ends = np.log([low, high]) if domain.has_log_codes else np.array([low, high])
    codes = ends[0] + np.linspace(0, 1, num) * (ends[1] - ends[0])
    values = [domain.of_code(float(code)) for code in (np.exp(codes) if domain.has_log_codes else codes)]
    places = np.linspace(0, 1, num)
    return [Gain(time, 0.0, 1.0 - abs(place - best), {"x": value}) for place, value in zip(places, values, strict=True)]


@pytest.mark.parametrize(
    ("given", "best", "expected"),
    [
        ({"uniform": [0.0, 10.0]}, 0.7, (6.0, 8.0)),
        ({"loguniform": [1e-6, 1e-2]}, 0.25, (3e-6, 3e-5)),
        ({"quniform": [0.0, 1.0, 0.1]}, 0.3, (0.2, 0.4)),
        ({"randint": [1, 101]}, 0.5, (40, 61)),
        ({"lograndint": [1, 1025]}, 0.5, (16, 64)),
        ({"power_of_two": [8, 512]}, 0.5, (32, 128)),
    ],
)
def test_values_are_near_those_that_gained_most_in_the_scale_of_their_range(
    given: dict[str, Any], best: float, expected: tuple[float, float]
) -> None:
    domain = DOMAIN.validate_python(given)
    gains = gains_at(domain, best)
    coming = Next(2.0, 0.0, gains[0].point, [])
    found = [propose(coming, {"x": domain}, gains, np.random.default_rng(seed), 0.25)["x"] for seed in range(5)]
    assert all(expected[0] <= value <= expected[1] for value in found), found
    assert all(domain.gives(value) for value in found), found
    assert {type(value) for value in found} == {type(domain.sample(np.random.default_rng(0)))}


def test_the_same_records_and_draws_give_the_same_point_in_whatever_order_they_come() -> None:
    gains = [*gains_at(DOMAIN.validate_python({"uniform": [0.0, 1.0]}), 0.3)]
    space, coming = {"x": DOMAIN.validate_python({"uniform": [0.0, 1.0]})}, Next(2.0, 0.0, {"x": 0.9}, [{"x": 0.5}])
    points = [propose(coming, space, known, np.random.default_rng(7), 0.25) for known in (gains, gains[::-1])]
    assert points[0] == points[1]


def test_what_gained_long_ago_counts_less_than_what_gains_now() -> None:
    domain = DOMAIN.validate_python({"uniform": [0.0, 1.0]})
    values = np.linspace(0.0, 1.0, 6)

    def gained(at: float, best: float) -> list[Gain]:
        return [Gain(at, 0.0, 1.0 - abs(x - best), {"x": float(x)}) for x in values]

    # Most intervals say that little is best; the newest ones say otherwise.
    gains = [
        *(one for at in range(1, 11) for one in gained(at, 0.1)),
        *(one for at in (19, 20) for one in gained(at, 0.9)),
    ]
    coming = Next(21.0, 0.0, {"x": 0.5}, [])
    found = [propose(coming, {"x": domain}, gains, np.random.default_rng(seed), 0.25)["x"] for seed in range(5)]
    assert min(found) > 0.6, found


def test_without_two_known_gains_everything_is_mutated() -> None:
    coming = Next(1.0, 0.0, {"lr": 1e-3, "clip": 0.5}, [])
    for gains in ([], [Gain(1.0, 0.0, 1.0, coming.point)]):
        for seed in range(5):
            expected = mutate(coming.point, SPACE, np.random.default_rng(seed), 0.25)
            assert propose(coming, SPACE, gains, np.random.default_rng(seed), 0.25) == expected


def test_lists_mutate_as_they_do_without_a_model() -> None:
    space = {"x": DOMAIN.validate_python({"uniform": [0.0, 1.0]}), "kind": DOMAIN.validate_python({"grid": [1, 2, 3]})}
    gains = [Gain(one.time, one.before, one.gain, {**one.point, "kind": 2}) for one in gains_at(space["x"], 0.3)]
    coming = Next(2.0, 0.0, {"x": 0.9, "kind": 2}, [])
    for seed in range(10):
        expected = mutate(coming.point, space, np.random.default_rng(seed), 0.25)["kind"]
        assert propose(coming, space, gains, np.random.default_rng(seed), 0.25)["kind"] == expected


def test_what_others_train_with_meanwhile_is_not_tried_twice() -> None:
    domain = DOMAIN.validate_python({"uniform": [0.0, 1.0]})
    # Nothing is known between 0.2 and 0.8, and all else gained the same.
    gains = [Gain(1.0, 0.0, 0.5, {"x": x}) for x in (0.0, 0.05, 0.1, 0.15, 0.85, 0.9, 0.95, 1.0)]
    first = propose(Next(2.0, 0.0, {"x": 0.0}, []), {"x": domain}, gains, np.random.default_rng(1), 0.25)
    then = propose(Next(2.0, 0.0, {"x": 0.0}, [first] * 3), {"x": domain}, gains, np.random.default_rng(1), 0.25)
    assert 0.2 < first["x"] < 0.8
    assert abs(then["x"] - first["x"]) > 0.1


def test_equal_gains_and_equal_scores_are_no_division_by_zero() -> None:
    coming = Next(2.0, 1.0, {"lr": 1e-3, "clip": 0.5}, [{"lr": 1e-3, "clip": 0.5}])
    gains = [Gain(1.0, 1.0, 0.0, coming.point)] * 5
    with np.errstate(all="raise", under="ignore"):
        point = propose(coming, SPACE, gains, np.random.default_rng(0), 0.25)
    assert SPACE["lr"].gives(point["lr"])


# -- from records


def record(number: int, point: dict[str, Any], *changes: tuple[int, str, int, dict[str, Any]]) -> TrialRecord:
    """A trial with changes: after which iteration, from whom, at which iteration of theirs, and what it had before."""
    made = [
        ChangeRecord(
            iteration=at, num_env_steps=100 * at, source_trial_id=source, source_iteration=theirs, before=before,
            after={}, time=0.0,
        )
        for at, source, theirs, before in changes
    ]  # fmt: skip
    name = f"t{number:04d}"
    return TrialRecord(trial_id=name, index=number, point_index=number, seed=0, point=point, changes=tuple(made))


def curve(*scores: float, every: int = 2) -> list[Score]:
    return [Score(every * at, 100 * every * at, score) for at, score in enumerate(scores, start=1)]


def test_an_interval_goes_from_one_comparison_to_the_next_and_begins_at_the_copied_score() -> None:
    a, b, c = {"lr": 1.0}, {"lr": 2.0}, {"lr": 3.0}
    trials = [record(0, c, (4, "t0001", 4, a), (8, "t0001", 8, b)), record(1, a)]
    curves = {"t0000": curve(1, 2, 5, 7, 4, 12), "t0001": curve(3, 6, 8, 9, 10, 11)}
    found = gains_of(trials, curves, 400)
    assert found[:3] == [
        # The first from its first evaluation, 200 env steps before the comparison.
        Gain(1.0, 1, (2 - 1) / 0.5, a),
        Gain(2.0, 6, 7 - 6, b),
        Gain(3.0, 9, 12 - 9, c),
    ]
    assert found[3:] == [Gain(1.0, 3, 6.0, a), Gain(2.0, 6, 3.0, a), Gain(3.0, 9, 2.0, a)]


def test_intervals_go_by_the_evaluations_there_are() -> None:
    # Every 300 env steps: compared at 600, 1,200, ...
    found = gains_of([record(0, {})], {"t0000": curve(1, 2, 4, 8, every=3)}, 400)
    assert [(one.time, one.before, one.gain) for one in found] == [(1.5, 1, 1 / 0.75), (3.0, 2, (8 - 2) / 1.5)]
    assert gains_of([record(0, {}), record(1, {})], {"t0000": curve(1, every=4)}, 400) == []


def test_an_interval_after_a_copy_begins_with_the_next_evaluation_where_the_copied_score_is_not_known() -> None:
    a, b = {"lr": 1.0}, {"lr": 2.0}
    trials = [record(0, b, (4, "t0001", 4, a))]
    # The jump from 2 to 50 is the copy's, and none that the new values have gained.
    found = gains_of(trials, {"t0000": curve(1, 2, 50, 54, 56, 60)}, 400)
    assert found == [Gain(1.0, 1, (2 - 1) / 0.5, a), Gain(2.0, 50, (54 - 50) / 0.5, b), Gain(3.0, 54, 60 - 54, b)]
    # As where every evaluation is a comparison.
    found = gains_of(trials, {"t0000": curve(2, 50, 54, every=4)}, 400)
    assert found == [Gain(3.0, 50, 4.0, b)]


def test_evaluations_are_read_once_and_again_where_results_were_replaced(tmp_path: Path) -> None:
    store = SweepStore(tmp_path / "mine")
    store.create()
    trial = store.trial("t0000")
    lines = [
        IterationRecord(
            iteration=at, num_env_steps=100 * at, num_episodes=at, time_s=1.0,
            evaluation_return=float(at) if at % 2 == 0 else None,
        )
        for at in range(1, 9)
    ]  # fmt: skip
    evaluations = Evaluations(store)
    assert evaluations(["t0000"]) == {"t0000": ()}
    trial.append_iterations(lines[:4])
    assert [one.iteration for one in evaluations(["t0000"])["t0000"]] == [2, 4]
    trial.append_iterations(lines[4:])
    assert evaluations(["t0000"]) == Evaluations(store)(["t0000"])
    assert [one.value for one in evaluations(["t0000"])["t0000"]] == [2.0, 4.0, 6.0, 8.0]
    trial.keep_iterations(lines[:5])
    assert [one.iteration for one in evaluations(["t0000"])["t0000"]] == [2, 4]

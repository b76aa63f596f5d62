"""What a model is told of the rungs that points passed, and what it makes of trainings that were ended early."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_search_methods import make_spec, record

from analysis.records import PriorPointRecord, PriorRecord, TrialRecord
from tests.narrowing import present
from tune_jobs.search.coordinates import Cube
from tune_jobs.search.fidelity import Lengths, length_of
from tune_jobs.search.gains import Score
from tune_jobs.search.gaussian_process import Posterior, fit
from tune_jobs.search.history import History, KnownPoint
from tune_jobs.search.prior import with_prior
from tune_jobs.search.proposal import next_point, propose_point
from tune_jobs.search.rungs import Passed, passed
from tune_jobs.search.two_objectives import weighed
from tune_jobs.search.warped import observed

WHOLE = 200_000
FIRST = WHOLE // 20
LR: dict[str, Any] = {"lr": {"uniform": [0.001, 1.0]}}
SPEC = make_spec(method="gp", space=LR, scheduler="asha", stop={"num_env_steps": WHOLE})
Curves = Mapping[str, Sequence[Score]]


def curve(*told: tuple[int, float]) -> list[Score]:
    return [Score(index + 1, steps, value) for index, (steps, value) in enumerate(told)]


def trial(index: int, steps: int, *, status: str = "stopped", score: float | None = 1.0, **changes: Any) -> TrialRecord:
    return record(index, {"lr": 0.5, **changes}, score, status=status, steps=steps, point_index=0)


# -- what points had come to


def test_a_rung_is_passed_at_the_first_evaluation_after_it_with_the_best_until_then() -> None:
    told = curve((8_000, 5.0), (10_100, 2.0), (20_000, 9.0), (30_000, 4.0), (90_000, 3.0), (WHOLE, 12.0))
    whole = trial(0, WHOLE, status="completed")
    assert passed(SPEC, [whole], {"t0000": told}) == (
        Passed(10_100 / WHOLE, 5.0), Passed(30_000 / WHOLE, 9.0), Passed(90_000 / WHOLE, 9.0),
    )  # fmt: skip
    # One that was ended at a rung has not passed that one, nor what lies beyond.
    assert passed(SPEC, [trial(0, 30_000)], {"t0000": told}) == (Passed(10_100 / WHOLE, 5.0),)
    assert passed(SPEC, [trial(0, 10_100)], {"t0000": told}) == ()
    assert passed(SPEC, [whole], {}) == passed(SPEC, [], {"t0000": told}) == ()


def test_an_evaluation_that_comes_after_two_rungs_is_told_once_and_one_without_a_number_not_at_all() -> None:
    whole = trial(0, WHOLE, status="completed")
    assert passed(SPEC, [whole], {"t0000": curve((40_000, 2.0), (WHOLE, 3.0))}) == (Passed(0.2, 2.0),)
    broken = curve((FIRST, math.nan), (30_000, 1.0), (WHOLE, 1.0))
    assert passed(SPEC, [whole], {"t0000": broken}) == ()


def test_of_several_seeds_the_mean_is_told_as_far_as_all_have_come() -> None:
    seeds = [trial(0, WHOLE, status="completed"), trial(1, 30_000)]
    curves = {
        "t0000": curve((FIRST, 2.0), (30_000, 6.0), (WHOLE, 7.0)),
        "t0001": curve((FIRST + 1_000, 4.0), (30_000, 5.0)),
    }
    ((trained, score),) = passed(SPEC, seeds, curves)
    assert trained == pytest.approx((FIRST + 500) / WHOLE)
    assert score == 3.0


def test_the_share_is_of_the_trial_s_own_length() -> None:
    spec = make_spec(
        method="gp", scheduler="asha", space={**LR, "stop.num_env_steps": {"choice": [40_000, WHOLE]}},
    )  # fmt: skip
    lengths: dict[str, Any] = {"stop.num_env_steps": 40_000}
    short = trial(0, 40_000, status="completed", **lengths)
    assert passed(spec, [short], {"t0000": curve((FIRST, 2.0), (40_000, 3.0))}) == (Passed(0.25, 2.0),)


def told(members: Sequence[TrialRecord], curves: Curves, **changes: Any) -> tuple[tuple[Passed, ...], list[str]]:
    """What is told of one point, and whose curves were read for it."""
    asked: list[str] = []

    def read(names: Sequence[str]) -> Curves:
        asked.extend(names)
        return {name: curves[name] for name in names}

    spec = make_spec(method="gp", space=LR, scheduler="asha", **changes)
    history = History(spec, curves=read)
    (point,) = history.known_points(members)
    assert history.known_points(members) == [point]
    return point.passed, asked


def test_curves_are_read_once_of_points_whose_seeds_have_ended_and_none_failed() -> None:
    curves = {"t0000": curve((FIRST, 2.0), (30_000, 3.0))}
    one = trial(0, 30_000)
    assert told([one], curves) == ((Passed(0.05, 2.0),), ["t0000"])
    beside = {**curves, "t0001": curve((FIRST, 4.0), (30_000, 3.0))}
    several = [one, trial(1, 30_000).model_copy(update={"seed_index": 1})]
    assert told(several, beside, seeds_per_point=2) == ((Passed(0.05, 3.0),), ["t0000", "t0001"])
    running = [one, trial(1, 20_000, status="running", score=None).model_copy(update={"seed_index": 1})]
    assert told(running, beside, seeds_per_point=2) == ((), [])
    failed = [one, trial(1, 20_000, status="failed").model_copy(update={"seed_index": 1})]
    assert told(failed, beside, seeds_per_point=2) == ((), [])


def test_scores_of_another_objective_are_not_compared_with_evaluations() -> None:
    one = trial(0, 30_000).model_copy(update={"objective_score": 0.5})
    assert told([one], {"t0000": curve((FIRST, 2.0), (30_000, 3.0))}, objective="area") == ((), [])


def test_score_and_cost_as_one_number_have_no_rungs() -> None:
    point = KnownPoint({"lr": 0.1}, (1.0,), (WHOLE,), passed=(Passed(0.05, 2.0),))
    assert [each.passed for each in weighed([point, KnownPoint({"lr": 0.2}, (2.0,), (WHOLE,))], 0, 0)] == [(), ()]


# -- the column


ENDED = KnownPoint({"lr": 0.25}, (6.0,), level=0, trained=0.05)
WENT_ON = KnownPoint({"lr": 0.75}, (3.0, 5.0), passed=(Passed(0.05, -9.0), Passed(0.15, 1.0)))
FAILED = KnownPoint({"lr": 0.5}, (None,), level=0, trained=0.05)


def test_a_model_has_the_column_where_points_were_ended_and_rungs_are_known() -> None:
    assert Lengths.among([ENDED, WENT_ON]).is_column
    plain = KnownPoint({"lr": 0.75}, (3.0,))
    for known in ([], [ENDED], [WENT_ON], [ENDED, plain], [FAILED, WENT_ON]):
        assert not Lengths.among(known).is_column
    assert [length_of(each) for each in (ENDED, WENT_ON, FAILED)] == [0.05, 1.0, 1.0]
    assert length_of(KnownPoint({}, (1.0,), level=0, trained=0.0)) == 1e-6


def test_scores_are_compared_whatever_their_lengths_which_stand_in_the_last_column() -> None:
    cube = Cube(SPEC.space)
    known = [FAILED, ENDED, WENT_ON, KnownPoint({"lr": 0.9}, is_running=True)]
    lengths = Lengths.among(known)
    seen, units = observed(cube, lengths.told(known), 60, lengths)
    # What failed, what was ended, then the first rung, the second and the end of what went on.
    assert [round(cube.point(place)["lr"], 6) for place in units] == [0.5, 0.25, 0.75, 0.75, 0.75]
    assert seen.columns[:, -1] == pytest.approx([0.0, -1.0, -1.0, math.log(0.15) / math.log(20.0), 0.0])
    assert np.argsort(seen.means).tolist() == [0, 2, 3, 4, 1]
    assert seen.counts.tolist() == [1, 1, 1, 1, 2]
    assert lengths.groups(cube).tolist() == [0, 1]
    assert lengths.of_whole(cube.columns(units))[:, -1].tolist() == [0.0] * 5
    assert len(lengths.places(units)) == 3


def test_without_a_scheduler_a_model_sees_what_it_saw() -> None:
    cube = Cube(SPEC.space)
    known = [KnownPoint({"lr": lr}, (lr,)) for lr in (0.1, 0.5, 0.7)]
    lengths = Lengths.among(known)
    seen, units = observed(cube, lengths.told(known), 60, lengths)
    assert seen.columns.shape == (3, 1)
    assert lengths.groups(cube).tolist() == [0]
    assert lengths.places(units) is units
    assert lengths.of_whole(seen.columns) is seen.columns


# -- what is proposed


def valley_and_plain(gap: float | None) -> list[KnownPoint]:
    """Points that came to their end, the best at 0.25, and beyond 0.5 others that all ended at the first rung.

    Args:
        gap: How much worse than the best of the former the latter were at that rung; None: the former's scores there
            are not known.
    """
    rng, known = np.random.default_rng(0), []
    for lr in map(float, np.linspace(0.02, 0.98, 24)):
        noise = rng.normal(size=3)
        if lr < 0.5:
            end = 10 - 100 * (lr - 0.25) ** 2
            rungs = (Passed(0.05, end - 25 + noise[1]), Passed(0.15, end - 12 + noise[2]))
            known.append(KnownPoint({"lr": lr}, (end + noise[0],), passed=() if gap is None else rungs))
        else:
            known.append(KnownPoint({"lr": lr}, (-15 - (gap or 0) + noise[0],), level=0, trained=0.05))
    return known


def proposed(known: Sequence[KnownPoint]) -> list[float]:
    return [next_point("gp", SPEC.space, known, 24 + k, seed=0, num_points=60)["lr"] for k in range(20)]


@pytest.mark.parametrize("gap", [25.0, 10.0, None])
def test_kinds_of_points_that_were_ended_are_avoided_where_others_were_better(gap: float | None) -> None:
    assert np.mean(np.array(proposed(valley_and_plain(gap))) < 0.5) >= 0.9


def test_what_is_expected_of_a_whole_training_follows_from_what_others_gained_after_the_same_rung() -> None:
    """By how far they got alone, what ended at a rung would be worse than all that did not, whatever it had there."""

    def expected(gap: float | None) -> tuple[float, float]:
        """At the best of the points that went on, and in the middle of those that were ended."""
        known, cube = valley_and_plain(gap), Cube(SPEC.space)
        lengths = Lengths.among(known)
        seen, _ = observed(cube, lengths.told(known), 200, lengths)
        settings = fit(seen, lengths.groups(cube))
        posterior = Posterior(settings, lengths.groups(cube), seen, seen.columns[:0])
        best, ended = posterior.at(lengths.of_whole(cube.columns(np.array([[0.25], [0.75]]))))[0]
        return float(best), float(ended)

    unknown, worse, equal = (expected(gap) for gap in (None, 25.0, 0.0))
    assert unknown[0] - unknown[1] > 1.0
    assert worse[0] - worse[1] > 1.0
    assert equal[1] > worse[1] + 0.1


def test_the_model_learns_what_whole_trainings_come_to_where_short_ones_say_the_contrary() -> None:
    """At first, the larger the learning rate the better; in the end the smaller, as a fifth of the points show."""
    known = []
    for index in range(60):
        lr = float(np.random.default_rng([7, index]).uniform(0.001, 1.0))
        if index % 5:
            known.append(KnownPoint({"lr": lr}, (10.0 * lr,), level=0, trained=0.05))
        else:
            known.append(KnownPoint({"lr": lr}, (30.0 - 20.0 * lr,), passed=(Passed(0.05, 10.0 * lr),)))
    assert np.median(proposed(known)) < 0.25


def test_what_points_had_come_to_at_rungs_changes_what_is_proposed() -> None:
    known = valley_and_plain(10.0)
    higher = [
        replace(point, passed=tuple(Passed(rung.trained, rung.score + 40) for rung in point.passed)) for point in known
    ]
    assert proposed(known) == proposed(list(known))
    assert proposed(higher) != proposed(known)


def test_what_was_ended_is_tried_beside_many_points_that_have_rungs() -> None:
    """150 whole points of three rungs each, and 24 of another kind that ended at the first, where they were worse."""
    space = make_spec(space={"gamma": {"uniform": [0.0, 1.0]}, "gae_lambda": {"uniform": [0.0, 1.0]}}).space
    found = []
    for seed in range(5):
        rng, known = np.random.default_rng(seed), []
        for index in range(174):
            lam = float(rng.uniform())
            if 75 <= index < 99:
                gamma = float(rng.uniform(0.75, 1.0))
                ended = KnownPoint({"gamma": gamma, "gae_lambda": lam}, (-10.0 + rng.normal(),), level=0, trained=0.05)
                known.append(ended)
                continue
            gamma = float(rng.uniform(0.0, 0.7))
            end = 10 - 40 * ((gamma - 0.3) ** 2 + (lam - 0.5) ** 2)
            rungs = tuple(Passed(share, end - off + rng.normal()) for share, off in ((0.05, 25), (0.15, 12), (0.45, 4)))
            known.append(KnownPoint({"gamma": gamma, "gae_lambda": lam}, (end + rng.normal() / 2,), passed=rungs))
        found += [next_point("gp", space, known, 174 + k, seed=seed)["gamma"] for k in range(2)]
    assert np.mean(np.array(found) > 0.72) <= 0.3


def test_seeds_that_are_equal_have_their_own_mean() -> None:
    seeds = [trial(index, WHOLE, status="completed") for index in range(6)]
    curves = {each.trial_id: curve((FIRST, -200.0), (WHOLE, -200.0)) for each in seeds}
    ((_, score),) = passed(SPEC, seeds, curves)
    assert score == -200.0


def test_a_point_of_an_earlier_sweep_has_the_length_of_the_own_point_of_its_rank() -> None:
    own = [KnownPoint({"lr": 0.01 * k}, (float(k),), level=0, trained=0.05) for k in range(12)]
    own += [KnownPoint({"lr": 0.5 + 0.01 * k}, (float(k),)) for k in range(12)]
    points = tuple(PriorPointRecord(point={"lr": 0.3}, share=share, trained=0.6) for share in (0.1, 0.9))
    found = with_prior(own, [PriorRecord(sweep="earlier", env_id="CartPole-v1", points=points)])[:2]
    # For when the model is asked they count as they were trained themselves.
    assert [(point.level, point.trained) for point in found] == [(0, 0.6), (None, 0.6)]
    assert [length_of(point) for point in found] == [0.05, 1.0]


def test_what_was_tried_is_tried_however_long_it_was_trained() -> None:
    """A point that a scheduler ended would be proposed again and again, as it was never seen at a training's end."""
    known, cube = valley_and_plain(25.0), Cube(SPEC.space)
    lengths = Lengths.among(known)
    seen, units = observed(cube, lengths.told(known), 200, lengths)
    whole = lengths.of_whole(cube.columns(lengths.places(units)))
    groups = lengths.groups(cube)
    settings, ended = fit(seen, groups), lengths.of_whole(cube.columns(np.array([[0.6], [0.75], [0.9]])))
    usual, lasting = (Posterior(settings, groups, seen, whole[:0], tried) for tried in (None, whole))
    assert lasting.at(whole)[1].max() < 0.02
    assert lasting.at(ended)[1].max() < 0.1 * usual.at(ended)[1].min()
    # What is expected is the same.
    assert lasting.at(ended)[0] == pytest.approx(usual.at(ended)[0])


def test_a_sweep_s_search_is_told_of_rungs_by_its_trials_curves() -> None:
    tried = valley_and_plain(0.0)
    records, curves = [], {}
    for index, point in enumerate(tried):
        is_whole, values = point.level is None, dict(point.point)
        status, steps = ("completed", WHOLE) if is_whole else ("stopped", FIRST)
        records.append(record(index, values, point.score, status=status, steps=steps))
        rungs = [(round(rung.trained * WHOLE), rung.score) for rung in point.passed]
        curves[records[-1].trial_id] = curve(*rungs, (steps, present(point.score)))
    history = History(SPEC, curves=lambda names: {name: curves[name] for name in names})
    told = history.known_points(records)
    # The best until a rung, so that a score that fell counts as it was.
    assert [len(point.passed) for point in told] == [len(point.passed) for point in tried]
    asked = [propose_point(SPEC, records, 24, lambda _: None, history=each) for each in (history, History(SPEC))]
    points = [
        next_point("gp", SPEC.space, known, 24, seed=SPEC.seed, num_startup_trials=8, num_points=40)
        for known in (told, [replace(point, passed=()) for point in told])
    ]
    assert asked == points
    assert asked[0] != asked[1]

"""What settings are judged by, and how they are ranked and raced."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from analysis.answers import certainty, setting_score
from analysis.best_records import SettingsRecord
from analysis.objectives import SettingScores, expected_means, rank_settings, score_of, trial_score
from analysis.racing import Race
from analysis.records import IterationRecord, Objective, TrialRecord, TrialStatus
from analysis.settings import judge_settings
from analysis.statistics import area_under_curve, iqm
from tests.narrowing import present

CAP = 10_000


def iteration(steps: int, evaluation: float | None = None, episodes: Sequence[float] = ()) -> IterationRecord:
    return IterationRecord(
        iteration=max(1, steps // 1_000),
        num_env_steps=steps,
        num_episodes=0,
        time_s=0.0,
        evaluation_return=evaluation,
        episode_returns=tuple(episodes),
    )


def score(iterations: Sequence[IterationRecord], objective: Objective, threshold: float | None = None) -> float | None:
    return trial_score(iterations, objective, num_env_steps=CAP, threshold=threshold)


RISING = [iteration(steps, steps / 100, [steps / 50] * 30) for steps in range(1_000, CAP + 1, 1_000)]


def test_final_is_of_the_later_half_three_parts_evaluations_and_one_part_training_episodes() -> None:
    # Evaluated at 60, 70, 80, 90, 100; episodes of 120, 140, 160, 180, 200.
    assert score(RISING, "final") == pytest.approx(0.75 * 80 + 0.25 * 160)


def test_an_evaluation_counts_for_the_env_steps_since_the_one_before() -> None:
    # The first covers 5,000 to 6,000, the second 6,000 to 10,000; one before the later half does not count.
    uneven = [iteration(4_000, 1.0), iteration(6_000, 50.0), iteration(10_000, 100.0)]
    assert score(uneven, "final") == pytest.approx(90)


def test_a_trial_that_ended_early_goes_on_as_it_was_at_last() -> None:
    # Evaluated at 60, 70, 80, 90, and 90 for the rest. Its last 100 episodes are of four iterations, 120 to 180, as are
    # those of the later half.
    assert score(RISING[:-1], "final") == pytest.approx(0.75 * 78 + 0.25 * 150)
    # In the later half 60 and 70, and 70 for three fifths; episodes of 120 and 140, and for the rest 80 to 140.
    assert score(RISING[:7], "final") == pytest.approx(0.75 * 68 + 0.25 * (0.4 * 130 + 0.6 * 110))
    # It ended before: 30, and all of its 90 episodes.
    assert score(RISING[:3], "final") == pytest.approx(0.75 * 30 + 0.25 * 40)


def test_one_that_solves_early_is_not_worse_than_one_that_solves_late() -> None:
    solved = [iteration(1_000, 100.0, [50] * 50), iteration(2_000, 200.0, [200] * 150)]
    returns = {steps: min(200.0, steps / 40) for steps in range(1_000, 9_001, 1_000)}
    late = [iteration(steps, value, [value] * 50) for steps, value in returns.items()]
    assert score(solved, "final") == 200
    assert present(score(late, "final")) < 200


def test_final_of_what_has_only_one_kind_of_episodes() -> None:
    assert score([iteration(1_000, None, [1, 2, 3])], "final") == 2
    assert score([iteration(1_000, 7.0), iteration(2_000, 9.0)], "final") == 9
    assert score([iteration(1_000)], "final") is None
    assert score([], "final") is None
    assert score([iteration(1_000, None, [math.nan, 4.0])], "final") == 4
    # No episode ended in the later half: those of before go on.
    assert score([iteration(1_000, None, [4.0]), iteration(10_000, None, [])], "final") == 4


def test_returns_near_the_largest_number_have_a_mean() -> None:
    huge = [iteration(steps, 1.7e308, [1.7e308] * 40) for steps in range(1_000, CAP + 1, 1_000)]
    assert score(huge, "final") == pytest.approx(1.7e308)


@pytest.mark.parametrize("reason", ["num_episodes 150 >= 150", "num_iterations 5 >= 5", "time_s 60 >= 60"])
def test_a_trial_that_trained_as_long_as_it_was_to_is_judged_by_its_own_later_half(reason: str) -> None:
    ended = trial(0, 0).model_copy(update={"stop_reason": reason, "num_env_steps": 6_000})
    # Evaluated at 40, 50, 60 in its later half; episodes of 80, 100, 120.
    assert score_of(ended, RISING[:6], "final", num_env_steps=CAP) == pytest.approx(0.75 * 50 + 0.25 * 100)
    assert score_of(ended, RISING[:6], "area", num_env_steps=CAP) == pytest.approx((10 * 1_000 + 35 * 5_000) / 6_000)
    assert score_of(ended, RISING[:6], "steps_to_threshold", num_env_steps=CAP, threshold=70) == -2 * CAP
    # All that rank settings do so.
    (found,) = rank_settings([ended], {ended.trial_id: RISING[:6]}, num_env_steps=CAP)
    assert found.scores == pytest.approx([62.5])


@pytest.mark.parametrize(
    ("status", "reason"),
    [("completed", "training_return 60 >= 60"), ("completed", "evaluation_return 60 >= 60"), ("stopped", "asha")],
)
def test_one_that_reached_its_goal_or_was_cut_goes_on_as_it_was(status: TrialStatus, reason: str) -> None:
    ended = trial(0, 0, status=status).model_copy(update={"stop_reason": reason, "num_env_steps": 6_000})
    assert score_of(ended, RISING[:6], "final", num_env_steps=CAP) == score(RISING[:6], "final")
    assert present(score(RISING[:6], "final")) > 62.5


def test_of_equal_returns_the_score_is_that_return_to_the_bit() -> None:
    for value in (200.0, -81.3, 0.1):
        level = [iteration(steps, value, [value] * 7) for steps in range(700, CAP + 1, 700)]
        assert score(level, "final") == value
        assert score(level[:9], "final") == value


def test_a_trial_that_collapsed_is_not_judged_by_its_best_evaluation() -> None:
    later = [iteration(steps, 20.0, [20] * 100) for steps in range(2_000, CAP + 1, 1_000)]
    collapsed = [iteration(1_000, 200.0, [200] * 100), *later]
    assert score(collapsed, "best") == 200
    assert score(collapsed, "final") == 20


def test_area_and_best_are_of_evaluations_alone() -> None:
    assert score(RISING, "best") == 100
    # Level until the first evaluation at 10, then straight up to 100.
    assert score(RISING, "area") == pytest.approx((10 * 1_000 + 55 * 9_000) / CAP)
    # A trial that ended early keeps its last evaluation.
    assert score(RISING[:5], "area") == pytest.approx((10 * 1_000 + 30 * 4_000 + 50 * 5_000) / CAP)
    assert score([iteration(1_000, None, [1])], "area") is None
    assert score([iteration(1_000, None, [1])], "best") is None


def test_steps_to_a_threshold_count_twice_the_cap_if_it_is_never_reached() -> None:
    assert score(RISING, "steps_to_threshold", 65) == -7_000
    assert score(RISING, "steps_to_threshold", 1_000) == -2 * CAP
    assert score([], "steps_to_threshold", 1) is None
    with pytest.raises(ValueError, match="needs a threshold"):
        score(RISING, "steps_to_threshold")


def trial(index: int, point_index: int, seed_index: int = 0, status: TrialStatus = "completed") -> TrialRecord:
    return TrialRecord(
        trial_id=f"t{index:04d}", index=index, point_index=point_index, seed_index=seed_index, seed=index,
        point={"lr": point_index}, status=status,
    )  # fmt: skip


def ranked(scores: Sequence[Sequence[float | None]], **fields: Any) -> list[SettingScores]:
    """Settings by the scores of their seeds; None: that seed failed."""
    trials, results = made(scores)
    return rank_settings(trials, results, num_env_steps=CAP, **fields)


def made(scores: Sequence[Sequence[float | None]]) -> tuple[list[TrialRecord], dict[str, list[IterationRecord]]]:
    trials: list[TrialRecord] = []
    results = {}
    for point_index, seeds in enumerate(scores):
        for seed_index, value in enumerate(seeds):
            record = trial(len(trials), point_index, seed_index, "failed" if value is None else "completed")
            trials.append(record)
            results[record.trial_id] = [] if value is None else [iteration(1_000, value)]
    return trials, results


def test_a_failed_seed_counts_as_the_worst_of_the_sweep() -> None:
    first, second, third = ranked([[100, None], [80, 82], [10, 12]])
    assert (first.point_index, second.point_index, third.point_index) == (1, 0, 2)
    assert second.scores == (100, 10)
    assert second.num_failed == 1


def test_by_env_steps_a_failed_seed_counts_as_one_that_never_reached_the_threshold() -> None:
    # One seed that reached it early and two that failed, beside three that reached it late.
    trials, results = made([[100.0, None, None], [100.0, 100.0, 100.0]])
    for late in trials[3:]:
        results[late.trial_id] = [iteration(1_000, 9.0), iteration(5_000, 100.0)]
    first, second = rank_settings(trials, results, "steps_to_threshold", num_env_steps=CAP, threshold=50.0)
    assert (first.point_index, first.scores) == (1, (-5_000, -5_000, -5_000))
    assert second.scores == (-1_000, -2 * CAP, -2 * CAP)
    # What trained to its end and never reached it is as bad.
    results["t0001"] = [iteration(CAP, 9.0)]
    trials[1] = trial(1, 0, 1)
    ranked_again = rank_settings(trials, results, "steps_to_threshold", num_env_steps=CAP, threshold=50.0)
    assert [item.scores for item in ranked_again] == [first.scores, second.scores]


def test_who_has_the_worst_score_for_a_failure_comes_behind_who_has_earned_it() -> None:
    # The worst score that is known is the best one, too.
    assert [item.point_index for item in ranked([[None], [None], [480], [None]])] == [2, 0, 1, 3]
    assert [item.point_index for item in ranked([[None, 500], [500, 500]])] == [1, 0]


def test_trials_that_have_not_ended_are_left_out() -> None:
    trials, results = made([[1], [5], [3]])
    trials[1] = trials[1].model_copy(update={"status": "running"})
    assert [item.point_index for item in rank_settings(trials, results, num_env_steps=CAP)] == [2, 0]
    assert ranked([[None], [None]]) == []
    assert rank_settings([], {}, num_env_steps=CAP) == []


def test_with_one_seed_a_setting_means_are_returned_as_they_are() -> None:
    assert expected_means([[3.0], [1.0], [2.0]]) == [3, 1, 2]
    assert expected_means([[3.0, 5.0]]) == [4]
    assert expected_means([[3.0, 3.0], [1.0, 1.0]]) == [3, 1]


def test_a_lucky_seed_is_drawn_back_further_than_many_good_ones() -> None:
    rng = np.random.default_rng(0)
    several = [list(100 + 10 * rng.standard_normal(6)) for _ in range(5)]
    good = [*several, list(118 + 10 * rng.standard_normal(6)), [122.0]]
    expected = expected_means(good)
    assert max(range(len(good)), key=lambda index: expected[index]) == 5
    assert 100 < expected[6] < 122
    # Where seeds hardly differ, one is enough.
    sure = expected_means([[100.0, 100.1, 99.9], [90.0, 90.1, 89.9], [122.0]])
    assert sure[2] == pytest.approx(122, abs=0.1)


# -- races


@pytest.mark.parametrize("num_contenders", [2, 3, 5, 8, 20])
@pytest.mark.parametrize("num_seeds", [1, 2, 3, 5, 7, 15])
def test_rounds_give_the_last_two_as_many_seeds_as_were_asked_for(num_contenders: int, num_seeds: int) -> None:
    race = Race(tuple(range(num_contenders)), num_seeds)
    sizes, seeds = zip(*race.rounds, strict=True)
    assert sum(seeds) == num_seeds
    assert all(seed >= 1 for seed in seeds)
    assert list(seeds) == sorted(seeds)
    assert sizes[0] == num_contenders
    assert all(later <= max(2, math.ceil(earlier / 2)) for earlier, later in itertools.pairwise(sizes))


def test_the_better_half_goes_on_with_twice_as_many_seeds() -> None:
    race = Race((4, 7, 1, 0), 3)
    assert race.rounds == ((4, 1), (2, 2))
    assert race.max_trainings == 8
    scores = {4: [50.0, 30.0], 7: [60.0, 65.0], 1: [44.0, 41.0], 0: [50.0, 55.0]}
    assert race.next_points({index: seeds[:1] for index, seeds in scores.items()}, 0) == (4, 7, 1, 0)
    assert race.next_points(scores, 1) == (7, 0, 7, 0)
    assert race.next_points(scores, 2) == ()


def test_of_scores_beyond_all_squares_nobody_is_out() -> None:
    race = Race((0, 1, 2), 3)
    scores = {0: [-100.0, -1e200], 1: [-200.0, -150.0], 2: [-300.0, -100.0]}
    assert len(race.next_points(scores, 1)) > 0


def test_a_race_ends_when_only_one_can_still_win() -> None:
    race = Race((0, 1, 2, 3), 7)
    scores = {0: [100.0, 101.0], 1: [50.0, 51.0], 2: [52.0, 51.0], 3: [49.0, 51.0]}
    assert race.next_points(scores, 1) == ()


def test_a_setting_that_seeds_of_the_search_show_cannot_win_gets_none_of_the_race() -> None:
    race = Race((0, 1, 2, 3), 3)
    scores = {0: [100.0, 101.0, 99.0], 1: [99.0, 100.0, 101.0], 2: [52.0, 51.0, 50.0], 3: [49.0, 51.0, 50.0]}
    assert set(race.next_points(scores, 0)) == {0, 1}


def test_no_race_of_less_than_two() -> None:
    assert Race((3,), 5).next_points({3: [1.0]}, 0) == ()
    assert Race((), 5).next_points({}, 0) == ()
    assert Race((), 5).max_trainings == 0


def test_races_find_the_best_setting_more_often_than_as_many_seeds_for_all() -> None:
    """Twenty settings, of which one is best by one standard deviation of seeds: both ways cost 40 trainings."""
    rng = np.random.default_rng(0)
    truth = np.linspace(-2, 1, 20)
    truth[19] = 1.7
    by_race = by_all = 0
    for _ in range(200):
        seeds = truth[:, None] + rng.standard_normal((20, 12))
        by_all += int(seeds[:, :2].mean(axis=1).argmax() == 19)
        used = dict.fromkeys(range(20), 1)
        contenders = tuple(int(index) for index in np.argsort(-seeds[:, 0])[:5])
        race = Race(contenders, 7)
        for num_done in range(3):
            scores = {index: list(seeds[index, : used[index]]) for index in contenders}
            for index in race.next_points(scores, num_done):
                used[index] += 1
        assert sum(used.values()) <= 40
        expected = expected_means([list(seeds[index, : used[index]]) for index in range(20)])
        by_race += int(np.argmax(expected) == 19)
    # Of 200 sweeps, 162 by a race and 119 by two seeds for all; so the difference is no luck.
    assert by_race > by_all + 20


# -- what is said


def judged(scores: Sequence[Sequence[float | None]], objective: Objective = "final", **fields: Any) -> SettingsRecord:
    trials, results = made(scores)
    return present(judge_settings(trials, results, objective, num_env_steps=CAP, **{"threshold": None} | fields))


def test_with_one_seed_a_setting_nothing_is_said_to_be_sure() -> None:
    settings = judged([[100.0], [90.0], [80.0]])
    assert settings.best.point == {"lr": 0}
    assert (settings.best.lower, settings.best.probability_best) == (None, None)
    assert settings.num_may_be_best == 3
    assert "one seed a setting" in certainty(settings)
    assert setting_score(settings) == "100.0 in the later half of training"


def test_intervals_and_chances_come_with_more_seeds() -> None:
    settings = judged([[100.0, 104.0, 99.0], [50.0, 52.0, 49.0], [60.0]])
    best = settings.best
    assert (best.point_index, best.trial_ids) == (0, ("t0000", "t0001", "t0002"))
    assert present(best.lower) < 101 < present(best.upper)
    assert present(best.probability_best) > 0.99
    assert settings.num_may_be_best == 1
    assert certainty(settings) == "the best of 3 with a probability of over 99 %; the data tell it from all others"
    assert "over training seeds" in setting_score(settings)


def test_settings_that_score_alike_are_not_told_apart() -> None:
    settings = judged([[100.0, 60.0], [99.0, 61.0], [98.0, 63.0]])
    assert settings.num_may_be_best == 3
    assert certainty(settings).endswith("; 2 others can't be told from it")
    constant = judged([[5.0, 5.0], [5.0, 5.0]])
    assert constant.num_may_be_best == 2
    assert constant.best.probability_best == 0.5


def test_steps_are_said_as_steps() -> None:
    trials, results = made([[100.0, 100.0], [10.0, 100.0]])
    settings = present(judge_settings(trials, results, "steps_to_threshold", num_env_steps=CAP, threshold=50.0))
    assert settings.best.scores == (-1_000, -1_000)
    assert setting_score(settings).startswith("1,000 env steps to the threshold")


def test_nothing_is_said_of_a_sweep_without_an_ended_trial() -> None:
    assert judge_settings([], {}, num_env_steps=CAP, threshold=None) is None


@pytest.mark.parametrize("scale", [1.7e308, -1.7e308, 1e-160, 1e-310])
@pytest.mark.parametrize("objective", ["final", "area", "best"])
def test_scores_of_any_size_have_means(scale: float, objective: Objective) -> None:
    levels = [[1.0, 0.9, 0.8], [0.5, 0.6, 0.4], [0.75]]
    settings = judged([[scale * level for level in seeds] for seeds in levels], objective)
    assert settings.best.point_index == (0 if scale > 0 else 1)
    for item in settings.ranking:
        assert item.score == pytest.approx(scale * np.mean(levels[item.point_index]), rel=1e-6, abs=0.0)
    # In another unit they are the same.
    expected = dict(zip(range(3), expected_means(levels), strict=True))
    for item in settings.ranking:
        assert item.expected == pytest.approx(scale * expected[item.point_index], rel=1e-6, abs=0.0)


def test_large_scores_of_both_signs_have_an_area_and_a_middle() -> None:
    curve = [1.7e308, -1.7e308, 1.7e308, 0.0]
    # Level, down and up again, and half of the way to 0: 1,000, 0, 0 and 375 times the first.
    area = area_under_curve([1_000, 2_000, 3_000, 4_000], curve, num_env_steps=3_500)
    assert area == pytest.approx(1.7e308 * (1.375 / 3.5))
    assert iqm([1.7e308, 1.7e308, 1.6e308]) == pytest.approx(5.0 / 3.0 * 1e308)


@pytest.mark.parametrize("value", [1e300, -1e300])
def test_huge_scores_have_no_interval(value: float) -> None:
    settings = judged([[value, value / 2], [value / 3, value / 4]])
    assert settings.best.lower is None

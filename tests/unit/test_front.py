"""The Pareto front of score against cost, and the cheapest setting near the best."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from analysis.exports.frames import SweepData, settings_frame
from analysis.front import NEAR, front_of, points_on_front, untrained_return
from analysis.front_words import cheapest_near_text, front_rows, near_text, undecided_text
from analysis.objectives import SettingScores, env_steps_of, score_of
from analysis.records import TRAINING_LENGTH, IterationRecord, TrialRecord, TrialStatus, length_of
from analysis.settings import judge_settings
from tests.narrowing import present

CAP = 10_000


def setting(index: int, scores: Sequence[float], *env_steps: int, expected: float | None = None) -> SettingScores:
    mean = math.fsum(scores) / len(scores)
    return SettingScores(
        index, {"lr": index}, tuple(scores), tuple(f"t{index:04d}" for _ in scores), 0,
        mean if expected is None else expected, env_steps or (CAP,) * len(scores),
    )  # fmt: skip


def ranked(*settings: SettingScores) -> list[SettingScores]:
    return sorted(settings, key=lambda item: (-item.expected, item.point_index))


def test_on_the_front_is_who_no_other_beats_in_both() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        # Few different numbers, so that many are equal.
        items = [setting(i, [float(rng.integers(5))], int(rng.integers(1, 6)) * 100) for i in range(12)]
        better = [
            {
                other.point_index
                for other in items
                if other.expected >= item.expected and other.cost <= item.cost
                and (other.expected, other.cost) != (item.expected, item.cost)
            }
            for item in items
        ]  # fmt: skip
        expected = {item.point_index for item, by in zip(items, better, strict=True) if not by}
        assert points_on_front(ranked(*items)) == expected
        found = present(front_of(ranked(*items), 0.0))
        assert {item.point_index for item in found.points} == expected
        costs = [item.num_env_steps for item in found.points]
        assert costs == sorted(costs)
        assert found.num_on_front == len(expected)


def test_the_cheapest_near_the_best_loses_a_twentieth_of_what_training_gained_at_most() -> None:
    scores = {0: (200, 900), 1: (191, 500), 2: (190, 300), 3: (189, 100), 4: (100, 50)}
    items = ranked(*(setting(index, [score], steps) for index, (score, steps) in scores.items()))
    found = present(front_of(items, 0.0))
    assert NEAR == 0.05
    assert found.near_score == pytest.approx(190)
    assert found.cheapest_near.point_index == 2
    assert (found.cheapest_near.rank, found.cheapest_near.num_env_steps) == (3, 300)
    assert [item.point_index for item in found.points] == [4, 3, 2, 1, 0]
    # The same returns, lower by 1,000, and all gains are the same.
    lower = [dataclasses.replace(item, expected=item.expected - 1_000) for item in items]
    assert present(front_of(lower, -1_000.0)).cheapest_near.point_index == 2
    # From 20 on, 191 is the least.
    assert present(front_of(items, 20.0)).cheapest_near.point_index == 1
    # Nothing is known, or nothing was gained.
    assert present(front_of(items, None)).cheapest_near.point_index == 0
    assert present(front_of(items, 500.0)).cheapest_near.point_index == 0
    equal = ranked(setting(0, [1.0], 200), setting(1, [1.0], 100))
    assert present(front_of(equal, 500.0)).cheapest_near.point_index == 1


def test_what_the_cheapest_saves_is_counted_from_the_best_one() -> None:
    """Of two that score the same, the dearer is the best one by its number, and not on the front."""
    found = present(front_of(ranked(setting(0, [500.0], 100_000), setting(1, [500.0], 20_000)), 20.0))
    assert (found.cheapest_near.point_index, found.num_on_front, found.best_env_steps) == (1, 1, 100_000)
    told = "lr 1: 500.0 for 20,000 env steps a training, 20 % of the best one's"
    assert cheapest_near_text(found).startswith(told)
    # A former record doesn't say what the best one costs.
    former = found.model_copy(update={"best_env_steps": None})
    assert cheapest_near_text(former).startswith("lr 1: 500.0 for 20,000 env steps a training")
    assert "%" not in cheapest_near_text(former)


def test_what_the_untrained_score() -> None:
    def rows(*returns: tuple[float, ...]) -> list[IterationRecord]:
        return [
            IterationRecord(iteration=i, num_env_steps=i, num_episodes=0, time_s=0.0, episode_returns=found)
            for i, found in enumerate(returns, start=1)
        ]

    results = {
        "t0000": rows((), (1.0, 3.0), (100.0,)), "t0001": rows((5.0,)), "t0002": rows((math.nan,), (9.0, math.inf)),
        "t0003": rows(()), "t0004": [],
    }  # fmt: skip
    assert untrained_return(results) == 5.0
    assert untrained_return({"t0004": []}) is None


def test_what_is_near_is_said_of_what_was_gained_too() -> None:
    items = ranked(setting(0, [2.0], 200), setting(1, [1.0], 100))
    assert "No episode was whole" in near_text(present(front_of(items, None)))
    assert "loses at most 5 % of what the best one gained on the untrained policies' 1.0" in near_text(
        present(front_of(items, 1.0))
    )
    for untrained in (2.0, 22.5):
        assert "gained nothing on the untrained policies'" in near_text(present(front_of(items, untrained)))


def test_with_one_seed_nothing_is_said_of_how_sure_it_is() -> None:
    found = present(front_of(ranked(setting(0, [2.0], 200), setting(1, [1.0], 100)), 0.0))
    assert found.num_undecided is None
    assert found.undecided == ()
    assert found.may_be_best is None
    assert "one seed" in undecided_text(found)


def test_who_can_not_be_told_from_the_front() -> None:
    seeds = (-2.0, -1.0, 0.0, 1.0, 2.0)
    items = [
        setting(0, [100 + each for each in seeds], 500),
        setting(1, [99.5 + each for each in seeds], 500),  # as dear and a little worse
        setting(2, [60 + each for each in seeds], 500),  # as dear and far worse
        setting(3, [50 + each for each in seeds], 100),
        setting(4, [49.5 + each for each in seeds], 101),  # a little dearer and a little worse
    ]
    found = present(front_of(ranked(*items), 0.0))
    assert [item.point_index for item in found.points] == [3, 0]
    assert [item.point_index for item in found.undecided] == [4, 1]
    assert found.num_undecided == 2
    assert found.may_be_best is True
    near = present(front_of(ranked(*items[:3], setting(5, [99 + each / 10 for each in seeds], 10)), 0.0))
    assert near.cheapest_near.point_index == 5


def test_of_settings_that_are_all_on_the_front_one_is_rarely_said_not_to_be() -> None:
    """All settings score the same on average and cost the same, so each is on the true front."""
    rng = np.random.default_rng(7)
    wrong = 0
    for _ in range(100):
        items = [setting(i, rng.normal(size=4).tolist(), 100) for i in range(6)]
        found = present(front_of(ranked(*items), 0.0))
        wrong += found.num_on_front + present(found.num_undecided) < len(items)
    assert wrong <= 11  # 5 of 100 are meant; 12 or more would come in less than 1 of 200 runs


def test_scores_that_are_not_finite_have_no_front() -> None:
    assert front_of([], 0.0) is None
    assert front_of([setting(0, [math.inf], 1), setting(1, [1.0], 1)], 0.0) is None
    assert points_on_front([setting(0, [math.inf], 1)]) == set()
    huge = [setting(i, [1.7e308, -1.7e308], 100, expected=float(i)) for i in range(3)]
    assert present(front_of(ranked(*huge), 0.0)).num_undecided is None


def trial(
    status: TrialStatus, steps: int, point: dict[str, Any] | None = None, index: int = 0, reason: str | None = None
) -> TrialRecord:
    return TrialRecord(
        trial_id=f"t{index:04d}", index=index, point_index=index, seed=0, point=point or {}, status=status,
        num_env_steps=steps, stop_reason=reason,
    )  # fmt: skip


def test_what_a_training_takes() -> None:
    own = {TRAINING_LENGTH: 4_000}
    assert env_steps_of(trial("completed", 1_500, reason="training_return 9 >= 9"), CAP) == 1_500
    assert env_steps_of(trial("completed", 10_240), CAP) == 10_240
    assert env_steps_of(trial("stopped", 500), CAP) == CAP
    assert env_steps_of(trial("failed", 0), CAP) == CAP
    assert env_steps_of(trial("failed", 0, own), CAP) == 4_000
    assert env_steps_of(trial("stopped", 500, own), CAP) == 4_000
    assert length_of(own, CAP) == 4_000
    assert length_of({TRAINING_LENGTH: 99_999}, CAP) == CAP
    assert length_of({TRAINING_LENGTH: "?"}, CAP) == CAP


def test_a_trial_is_judged_by_the_later_half_of_its_own_length() -> None:
    rows = [
        IterationRecord(iteration=i, num_env_steps=1_000 * i, num_episodes=0, time_s=0.0, evaluation_return=float(i))
        for i in range(1, 5)
    ]
    stopped = trial("stopped", 4_000, {TRAINING_LENGTH: 4_000})
    # Evaluated at 3 and 4 in the later half of 4,000; of 10,000 it is taken to go on at 4.
    assert score_of(stopped, rows, "final", num_env_steps=CAP) == pytest.approx(3.5)
    assert score_of(trial("stopped", 4_000), rows, "final", num_env_steps=CAP) == pytest.approx(4.0)
    # Who never reaches a threshold counts the same, however short it was to be.
    late = score_of(stopped, rows, "steps_to_threshold", num_env_steps=CAP, threshold=9.0)
    assert late == -2 * CAP


def test_settings_are_set_against_their_cost_if_that_is_asked_for() -> None:
    def ended(index: int, steps: int, value: float) -> tuple[TrialRecord, list[IterationRecord]]:
        record = trial("completed", steps, {"lr": index}, index, "training_return 1 >= 1")
        rows = [
            IterationRecord(
                iteration=i, num_env_steps=at, num_episodes=0, time_s=0.0, evaluation_return=told,
                episode_returns=(returns,) * 200,
            )
            for i, (at, told, returns) in enumerate([(1, None, 10.0), (steps, value, value)], start=1)
        ]  # fmt: skip
        return record, rows

    made = [ended(0, 9_000, 100.0), ended(1, 2_000, 99.0), ended(2, 9_500, 10.0), ended(3, 9_600, 1.0)]
    trials, results = [one for one, _ in made], {one.trial_id: rows for one, rows in made}
    plain = present(judge_settings(trials, results, num_env_steps=CAP, threshold=None))
    assert plain.front is None
    assert cheapest_near_text(plain.front) == ""
    both = present(judge_settings(trials, results, num_env_steps=CAP, threshold=None, cost="env_steps"))
    front = present(both.front)
    assert [item.point_index for item in front.points] == [1, 0]
    assert both.best.point_index == 0
    assert cheapest_near_text(both.front) == "lr 1: 99.0 for 2,000 env steps a training, 22 % of the best one's"
    assert [row.on_front for row in front_rows(front)] == ["yes, the cheapest near the best", "yes"]
    assert (
        "on the untrained policies' 10.0: one whose mean, drawn back to that of all settings, is 95.5 or more"
        in near_text(front)
    )
    alone = present(judge_settings(trials[:1], results, num_env_steps=CAP, threshold=None, cost="env_steps"))
    assert "the best setting itself" in cheapest_near_text(alone.front)


def test_many_settings_take_no_time_to_speak_of() -> None:
    rng = np.random.default_rng(0)
    items = [setting(i, rng.normal(size=2).tolist(), 100 + i, 100 + i) for i in range(2_000)]
    found = present(front_of(ranked(*items), 0.0))
    costs = [item.num_env_steps for item in found.points]
    assert all(one < two for one, two in itertools.pairwise(costs))


def of_lengths(
    *rows: tuple[float, int, float | None, TrialStatus],
) -> tuple[list[TrialRecord], dict[str, list[IterationRecord]]]:
    """Trials of lr, the length that was searched, what they scored (None: no whole episode), and how they ended."""
    trials, results = [], {}
    for index, (lr, length, score, status) in enumerate(rows):
        point = {"lr": lr, TRAINING_LENGTH: length}
        record = trial(status, length if status == "completed" else 0, point, index, "num_env_steps")
        trials.append(record)
        returns = [] if score is None else [(length // 4, 20.0, 20), (length, score, 100)]
        results[record.trial_id] = [
            IterationRecord(
                iteration=i, num_env_steps=steps, num_episodes=0, time_s=0.0, evaluation_return=told,
                episode_returns=(told,) * number,
            )
            for i, (steps, told, number) in enumerate(returns, start=1)
        ]  # fmt: skip
    return trials, results


CRASHED: tuple[float, int, float | None, TrialStatus] = (0.5, 5_000, None, "failed")
EASY: tuple[tuple[float, int, float | None, TrialStatus], ...] = (
    (1e-3, 100_000, 500.0, "completed"), (3e-3, 80_000, 495.0, "completed"), (1e-4, 60_000, 490.0, "completed"),
)  # fmt: skip


@pytest.mark.parametrize("unscored", [CRASHED, (0.5, 5_000, None, "completed")])
def test_a_short_setting_without_a_score_of_its_own_is_not_the_cheapest_near_the_best(
    unscored: tuple[float, int, float | None, TrialStatus],
) -> None:
    trials, results = of_lengths(*EASY, unscored)
    found = present(judge_settings(trials, results, num_env_steps=100_000, threshold=475.0, cost="env_steps"))
    front = present(found.front)
    assert front.cheapest_near.point["lr"] == 1e-4
    assert [item.point["lr"] for item in front.points] == [1e-4, 3e-3, 1e-3]
    assert front.undecided == ()
    # It keeps its place in the ranking, behind who has earned the same score.
    assert [item.point["lr"] for item in found.ranking] == [1e-3, 3e-3, 1e-4, 0.5]
    frame = settings_frame(SweepData(trials, results, "final", num_env_steps=100_000, threshold=475.0))
    assert frame["on_front"].tolist() == [True, True, True, False]


def test_a_short_setting_that_only_crashed_hides_none_that_has_the_worst_score() -> None:
    rows: list[tuple[float, int, float | None, TrialStatus]] = [
        (1e-3, 100_000, 500.0, "completed"), (3e-3, 60_000, 300.0, "completed"), (1e-4, 10_000, 100.0, "completed"),
    ]  # fmt: skip
    trials, results = of_lengths(*rows, CRASHED)
    found = present(judge_settings(trials, results, num_env_steps=100_000, threshold=475.0, cost="env_steps"))
    assert [item.point["lr"] for item in present(found.front).points] == [1e-4, 3e-3, 1e-3]


def test_a_setting_of_which_one_seed_of_several_failed_stays_on_the_front() -> None:
    trials, results = of_lengths(*EASY, (0.5, 5_000, 480.0, "completed"), CRASHED)
    trials[-1] = trials[-1].model_copy(update={"point_index": 3, "seed_index": 1})
    found = present(judge_settings(trials, results, num_env_steps=100_000, threshold=475.0, cost="env_steps"))
    assert present(found.front).points[0].point["lr"] == 0.5


def test_settings_of_which_none_was_scored_have_no_front() -> None:
    failed = [dataclasses.replace(setting(index, [1.0, 1.0], 100, 100), num_unscored=2) for index in range(2)]
    assert front_of(failed, 0.0) is None
    assert points_on_front(failed) == set()
    # Those that can't be told from it are such as were scored, too.
    items = [setting(0, [9.0, 11.0], 500, 500), setting(1, [8.0, 10.0], 500, 500), *failed]
    found = present(front_of(ranked(*items[:2], dataclasses.replace(failed[0], point_index=2)), 0.0))
    assert [item.point_index for item in found.undecided] == [1]

"""A race of `confirm` when a trial that had failed is trained after all, and its setting leads."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
import pytest
from test_confirm import added, spec, trials

from analysis.objectives import SettingScores
from analysis.records import TrialRecord
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.sweeps.confirm import race_under_way

NUM_POINTS = 20
NOISE = np.random.default_rng(0).normal(0.0, 20.0, (NUM_POINTS, 100)).tolist()
"""Of each training seed of each point: none can't be the best."""


class Sweep:
    """What a sweep's race is decided by: scores of its points, and the rounds that there were."""

    def __init__(self, scores: Sequence[float], **confirm: float) -> None:
        self.scores = list(scores)
        self.rounds: list[tuple[int, ...]] = []
        self.spec: SweepSpec = spec(num_samples=NUM_POINTS, confirm={"top": 5, "seeds": 3, "max_share": 2.0, **confirm})

    def ranked_of(self, known: Sequence[TrialRecord]) -> list[SettingScores]:
        settings = []
        for point, score in enumerate(self.scores):
            seeds = [trial for trial in known if trial.point_index == point]
            own = tuple(score + NOISE[point][place] for place in range(len(seeds)))
            settings.append(
                SettingScores(
                    point_index=point, point={"lr": 0.001 * (1 + point)}, scores=own, num_failed=0, expected=score,
                    trial_ids=tuple(trial.trial_id for trial in seeds), env_steps=(1,) * len(seeds),
                )
            )  # fmt: skip
        return sorted(settings, key=lambda item: -item.expected)

    def next_round(self) -> tuple[tuple[int, ...], int]:
        """The points of the next round, and how many rounds of its race are over."""
        records = trials(NUM_POINTS, more=tuple(point for points in self.rounds for point in points))
        race, _, num_done = race_under_way(
            self.spec, records, [added(NUM_POINTS, *points) for points in self.rounds], self.ranked_of
        )
        scores = {item.point_index: item.scores for item in self.ranked_of(records)}
        return (() if race is None else race.next_points(scores, num_done)), num_done

    def go_on(self, most: int = 100) -> list[int]:
        """Have the rounds that are left, or so many of them; return of each how many of its race were over before."""
        over: list[int] = []
        while len(over) < most and (following := self.next_round())[0]:
            self.rounds.append(following[0])
            over.append(following[1])
        return over


FAILED = [-100.0, 60.0, 59.0, 58.0, 57.0, 56.0, *([1.0] * 14)]
"""The trial of point 0 failed."""


@pytest.mark.parametrize("num_done", [0, 1, 2, 3])
def test_a_race_goes_on_with_those_that_led_before_it(num_done: int) -> None:
    whole, cut = Sweep(FAILED), Sweep(FAILED)
    assert whole.go_on() == [0, 1, 2]
    assert set(whole.rounds[0]) == {1, 2, 3, 4, 5}
    cut.go_on(num_done)
    assert cut.go_on() == list(range(num_done, 3))
    assert cut.rounds == whole.rounds


@pytest.mark.parametrize("num_done", [1, 2, 3])
def test_a_setting_that_came_to_lead_begins_another_race(num_done: int) -> None:
    sweep = Sweep(FAILED)
    sweep.go_on(num_done)
    sweep.scores[0] = 61.0
    assert sweep.go_on() == [0, 1, 2]
    # Some may be out already, by the seeds of the race that was given up.
    assert {0} < set(sweep.rounds[num_done]) <= {0, 1, 2, 3, 4}
    assert Counter(point for points in sweep.rounds for point in points)[0] >= 1
    # It is over, and an end that is asked for again begins none.
    assert sweep.go_on() == []


def test_a_setting_that_would_not_race_changes_nothing() -> None:
    sweep = Sweep(FAILED)
    sweep.go_on()
    sweep.scores[0] = 15.0
    assert sweep.go_on() == []


def test_no_round_is_of_a_race_that_had_none() -> None:
    sweep = Sweep([1000.0, *FAILED[1:]])
    sweep.rounds = [(1, 2, 3, 4, 5), (1, 2, 3)]
    # It leads by so much that it need not race: with the seeds of the first round, which are another race's, neither.
    assert sweep.next_round() == ((), 0)


def test_both_races_keep_to_the_share() -> None:
    sweep = Sweep(FAILED, max_share=0.5)
    sweep.go_on()
    sweep.scores[0] = 61.0
    sweep.go_on()
    assert sum(map(len, sweep.rounds)) <= 0.5 * NUM_POINTS
